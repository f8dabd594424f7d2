"""The paper's scaling chains: they are what the rules say, and impossible sizes are refused in one line."""

from __future__ import annotations

import pytest

from ce_gym.bench import chains
from ce_gym.model import RobotError, check_robot, cluster_tree

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


@pytest.mark.parametrize(
    ("robot", "bodies", "rotors", "clusters", "independent", "mass"),
    [
        (chains.link_and_rotor_chain(2, 3), 13, 6, 7, 6, 11.0),
        (chains.belt_pair_chain(2, 2), 17, 8, 5, 8, 13.0),
        (chains.four_bar_chain(2, 2), 13, 0, 5, 4, 44.6),
        (chains.transmission_parallel_chain(5, 4), 10, 0, 7, 9, 2.5),
        (chains.transmission_parallel_chain(10, 12), 20, 0, 9, 19, 5.0),
        (chains.rod_parallel_chain(5, 5), 11, 0, 7, 9, 2.75),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_counts(robot, bodies, rotors, clusters, independent, mass):
    check_robot(robot)
    assert len(robot.bodies) == bodies
    assert len(list(robot.rotors())) == rotors
    assert len(cluster_tree(robot).clusters) == clusters
    assert len(robot.independent) == independent
    assert robot.total_mass == pytest.approx(mass)


def test_largest_cluster_has_the_size_that_was_asked_for():
    for size in (2, 6, 10):
        assert max(len(c.bodies) for c in cluster_tree(chains.transmission_parallel_chain(5, size)).clusters) == size
    for size in (3, 7, 11):
        assert max(len(c.bodies) for c in cluster_tree(chains.rod_parallel_chain(5, size)).clusters) == size


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: chains.link_and_rotor_chain(0, 3), "branches"),
        (lambda: chains.belt_pair_chain(1, 0), "depth"),
        (lambda: chains.four_bar_chain(-1, 1), "branches"),
        (lambda: chains.transmission_parallel_chain(5, 5), "loop_size"),
        (lambda: chains.transmission_parallel_chain(5, 12), "loop_size"),
        (lambda: chains.rod_parallel_chain(5, 4), "loop_size"),
        (lambda: chains.rod_parallel_chain(5, 13), "loop_size"),
    ],
)
def test_impossible_sizes_are_refused(make, key):
    with pytest.raises(RobotError, match=key) as caught:
        make()
    assert "\n" not in str(caught.value)
