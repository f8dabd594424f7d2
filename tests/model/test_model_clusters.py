"""Which bodies form a cluster: rules on small trees by hand, and the promises of the tree on random ones."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ce_gym.model import (
    Body,
    Inertial,
    Joint,
    LinearConstraint,
    Placement,
    Robot,
    RobotError,
    check_robot,
    cluster_tree,
)

UNIT = Inertial(1.0, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))


def robot(parents: dict[str, str | None], *ties: tuple[str, ...], free: str | None = None, independent=()) -> Robot:
    """A robot of equal bodies; every tie is a sum of joint angles that is zero."""
    bodies = tuple(
        Body(name, "link", parent, Placement(), Joint("free" if name == free else "revolute"), UNIT)
        for name, parent in parents.items()
    )
    constraints = tuple(LinearConstraint(f"tie {i}", tuple((body, 1.0) for body in tie)) for i, tie in enumerate(ties))
    return Robot("synthetic", bodies, constraints, tuple(independent))


def groups(robot: Robot) -> list[tuple[str, ...]]:
    return [cluster.bodies for cluster in cluster_tree(robot).clusters]


def test_no_constraint_leaves_every_body_alone():
    chain = robot({"a": None, "b": "a", "c": "b"})
    assert groups(chain) == [("a",), ("b",), ("c",)]
    assert [cluster.parent for cluster in cluster_tree(chain).clusters] == [None, 0, 1]


def test_gear_on_one_parent():
    geared = robot({"base": None, "link": "base", "rotor": "base", "tip": "link"}, ("link", "rotor"), free="base")
    assert groups(geared) == [("base",), ("link", "rotor"), ("tip",)]
    cluster = cluster_tree(geared).clusters[1]
    assert (cluster.parent, cluster.output_body) == (0, "base")
    assert cluster_tree(geared).clusters[2].output_body == "link"


def test_belt_over_a_joint_is_one_cluster_of_four():
    parents = {"thigh": None, "knee": "thigh", "r1": "thigh", "r2": "thigh", "ankle": "knee"}
    assert groups(robot(parents, ("r1", "knee"), ("r2", "knee", "ankle"))) == [
        ("thigh",),
        ("knee", "r1", "r2", "ankle"),
    ]
    # The ankle belt alone needs the knee too, even if its ratio did not name it.
    assert groups(robot(parents, ("r2", "ankle"))) == [("thigh",), ("knee", "r2", "ankle"), ("r1",)]


def test_tie_to_the_own_parent_and_to_the_grandparent():
    chain = {"a": None, "b": "a", "c": "b", "d": "c"}
    assert groups(robot(chain, ("a", "b"))) == [("a", "b"), ("c",), ("d",)]
    assert groups(robot(chain, ("b", "d"))) == [("a",), ("b", "c", "d")]


def test_rotor_on_a_far_carrier_takes_in_the_joints_between():
    parents = {"base": None, "hip": "base", "thigh": "hip", "shank": "thigh", "rotor": "base"}
    assert groups(robot(parents, ("rotor", "shank"))) == [("base",), ("hip", "thigh", "shank", "rotor")]


def test_tie_across_two_legs_leaves_the_trunk_out():
    parents = {"trunk": None, "l1": "trunk", "l2": "l1", "r1": "trunk", "r2": "r1"}
    assert groups(robot(parents, ("l2", "r2"))) == [("trunk",), ("l1", "l2", "r1", "r2")]


def test_overlapping_constraints_merge_and_keep_one_output_body():
    parents = {"a": None, "b": "a", "c": "b", "d": "c", "r": "c"}
    tree = cluster_tree(robot(parents, ("d", "r"), ("b", "d")))
    assert [cluster.bodies for cluster in tree.clusters] == [("a",), ("b", "c", "d", "r")]
    assert tree.clusters[1].output_body == "a"
    assert len(tree.clusters[1].constraints) == 2


def test_common_ancestor_joins_if_another_constraint_needs_it():
    parents = {"a": None, "b": "a", "r": "a", "c": "b", "s": "b"}
    assert groups(robot(parents, ("c", "s"), ("r", "b", "c"))) == [("a",), ("b", "r", "c", "s")]


def test_cluster_of_a_late_rotor_keeps_its_place_before_its_children():
    """The rotor comes last in the file; its cluster still comes before the body that hangs on its link."""
    parents = {"link": None, "tip": "link", "rotor": None}
    assert groups(robot(parents, ("link", "rotor"))) == [("link", "rotor"), ("tip",)]


def test_tie_across_a_floating_base_is_refused():
    parents = {"base": None, "link": "base", "rotor": None}
    with pytest.raises(RobotError, match=r"tie 0 is .*across the free joint of base"):
        cluster_tree(robot(parents, ("link", "rotor"), free="base"))


def test_lookups_and_drawing():
    tree = cluster_tree(robot({"a": None, "b": "a", "r": "a", "c": "a"}, ("b", "r"), independent=("a", "b", "c")))
    assert list(tree.base_to_tip()) == [0, 1, 2]
    assert list(tree.tip_to_base()) == [2, 1, 0]
    assert tree.cluster_of("r") == 1
    assert tree.as_text().splitlines() == ["world", "└── a*", "    ├── b* + r", "    └── c*"]
    with pytest.raises(KeyError, match="'nobody'"):
        tree.cluster_of("nobody")


@pytest.mark.parametrize(
    ("independent", "message"),
    [
        (("a", "b", "r"), "1 of them"),
        ((), "1 of them"),
        (("a",), "1 of them"),
        (("a", "b", "b"), "used once"),
        (("a", "x"), "did you mean|name of a body"),
    ],
)
def test_wrong_independent_joints_are_refused(independent, message):
    geared = robot({"a": None, "b": "a", "r": "a"}, ("b", "r"), independent=("a", "b"))
    check_robot(geared)
    with pytest.raises(RobotError, match=message):
        check_robot(dataclasses.replace(geared, independent=independent))


def test_singular_choice_and_too_many_constraints_are_refused():
    tied = robot({"a": None, "b": None, "c": None}, ("a", "b"), independent=("a", "b"))  # c is free, a fixes b
    with pytest.raises(RobotError, match="1 of them"):
        check_robot(tied)
    doubled = robot({"a": None, "b": None, "c": None}, ("a", "b", "c"), ("a", "c", "b"), independent=("a",))
    with pytest.raises(RobotError, match=r"determine b, c; these do not"):
        check_robot(doubled)
    locked = robot({"a": None, "b": None}, ("a", "b"), ("b", "a"))
    with pytest.raises(RobotError, match="fewer constraints than bodies"):
        check_robot(locked)


@st.composite
def random_robots(draw) -> Robot:
    count = draw(st.integers(2, 12))
    parents: dict[str, str | None] = {}
    for i in range(count):
        parents[f"b{i}"] = draw(st.sampled_from([None, *parents]))
    bodies = st.lists(st.sampled_from(list(parents)), min_size=2, max_size=4, unique=True)
    return robot(parents, *draw(st.lists(bodies, max_size=4)))


@settings(deadline=None)  # other work on the machine must not fail the test
@given(random_robots())
def test_promises_of_the_tree(robot):
    tree = cluster_tree(robot)
    parents = {body.name: body.parent for body in robot.bodies}
    listed = [body for cluster in tree.clusters for body in cluster.bodies]
    assert sorted(listed) == sorted(parents), "every body is in one cluster"
    for i, cluster in enumerate(tree.clusters):
        outside = {parents[body] for body in cluster.bodies} - set(cluster.bodies)
        assert outside == {cluster.output_body}, "one output body"
        assert cluster.parent == (None if cluster.output_body is None else tree.cluster_of(cluster.output_body))
        assert cluster.parent is None or cluster.parent < i, "parents before children"
        for j, body in enumerate(cluster.bodies):
            assert parents[body] not in cluster.bodies[j:], "parents before children inside a cluster"
    for constraint in robot.constraints:
        assert len({tree.cluster_of(body) for body in constraint.bodies}) == 1
    assert sum(len(cluster.constraints) for cluster in tree.clusters) == len(robot.constraints)
    if not robot.constraints:
        assert all(len(cluster.bodies) == 1 for cluster in tree.clusters)
