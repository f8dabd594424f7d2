"""The transmission report: figures that can be checked by hand, and errors of the levels."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ce_gym.bench.chains import rod_parallel_chain
from ce_gym.diagnostics.transmission import (
    LEAST_NEARNESS,
    analyse_transmissions,
    random_states,
    transmission_report,
)
from ce_gym.dynamics import Model
from ce_gym.model import Body, Inertial, Joint, LinearConstraint, Placement, Pose, Robot, load_robot

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def test_gears_of_mini_cheetah():
    report = analyse_transmissions(Model("mini_cheetah"), states=0)
    figures = {c.joints[0]: c for c in report.clusters}
    assert len(figures) == 12
    assert report.without_rotors == ()
    for joint, cluster in figures.items():
        ratio = 9.33 if "knee" in joint else 6.0
        (rotor,) = cluster.rotors
        assert rotor.ratios == {joint: ratio}
        assert rotor.inertia == 63e-6
        assert rotor.symmetric
        assert cluster.reflected == pytest.approx(np.array([[ratio**2 * 63e-6]]), rel=1e-12)
    assert figures["FL_hip_link"].reflected[0, 0] == pytest.approx(0.002268, abs=5e-7)
    assert figures["FL_knee_link"].reflected[0, 0] == pytest.approx(0.005484, abs=5e-7)


def test_belt_of_the_leg():
    cluster = analyse_transmissions(Model("mit_humanoid_leg"), states=0).clusters[-1]
    assert cluster.joints == ("knee_link", "ankle_link")
    expected = [[0.1041422, 0.0242510], [0.0242510, 0.0242510]]  # of the paper's library
    np.testing.assert_allclose(cluster.reflected, expected, atol=5e-8)
    ratios = {rotor.name: rotor.ratios for rotor in cluster.rotors}
    assert ratios["ankle_rotor"] == {"knee_link": 12.0, "ankle_link": 12.0}
    assert ratios["knee_rotor"] == {"knee_link": 12.0}
    assert ((cluster.share > 0.0) & (cluster.share < 1.0)).all()


def test_reflected_inertia_is_what_the_coupled_level_adds(robot: Robot):
    coupled, none = Model(robot, "coupled"), Model(robot, "none")
    added = coupled.mass_matrix(coupled.standing_q) - none.mass_matrix(none.standing_q)
    reflected = np.zeros_like(added)
    first = coupled.nv - len(coupled.joint_links)
    for cluster in analyse_transmissions(coupled, states=0).clusters:
        rows = [first + coupled.joint_links.index(joint) for joint in cluster.joints]
        reflected[np.ix_(rows, rows)] = cluster.reflected
    np.testing.assert_allclose(added, reflected, atol=1e-12)


def test_errors_grow_with_what_is_dropped():
    errors = {e.level: e for e in analyse_transmissions(Model("mit_humanoid_leg"), states=100).errors}
    assert list(errors) == ["coupled", "armature", "none"]
    assert errors["coupled"].base is None
    medians = [error.joints.median for error in errors.values()]
    assert 0.0 < medians[0] < medians[1] < medians[2]
    assert all(error.joints.median <= error.joints.max for error in errors.values())


def test_errors_are_of_accelerations():
    """One geared joint on the world: exact = coupled = armature, and `none` is wrong by the reflected share."""
    report = analyse_transmissions(Model(geared_joint()), states=50)
    errors = {error.level: error for error in report.errors}
    assert errors["coupled"].joints.max < 1e-12
    assert errors["armature"].joints.max < 1e-12
    share = report.clusters[0].share[0]
    assert share == pytest.approx(100 * 2e-4 / (0.1 + 100 * 2e-4))
    assert errors["none"].joints.median == pytest.approx(share / (1 - share), rel=1e-9)


def test_base_is_apart_from_joints():
    errors = analyse_transmissions(Model("mini_cheetah"), states=50).errors
    assert all(error.base is not None and 0.0 < error.base.median <= error.base.max for error in errors)


def test_states_respect_joint_limits():
    model = Model(load_robot("mini_cheetah"))
    q, _, tau = random_states(model, 100, np.random.default_rng(0))
    limits = np.array([model.robot.body(name).joint.position for name in model.joint_links])
    assert ((q[:, 7:] >= limits[:, 0]) & (q[:, 7:] <= limits[:, 1])).all()
    assert (tau[:, :6] == 0.0).all()


def test_states_of_closed_loops_can_be_assembled():
    """Chains that lie along the line of their roots are at a singularity, and with bent knees they do not meet."""
    chains = rod_parallel_chain(2, 5)
    lying = dataclasses.replace(
        chains, pose=Pose(joints=(("link_1_1", 1.45),)), assembly=(("link_2_1", 1.45), ("connecting_rod", -1.45))
    )
    for robot, fewest, most in ((chains, 50, 50), (lying, 5, 45)):
        model = Model(robot)
        q, v, tau = random_states(model, 50, np.random.default_rng(0))
        assert fewest <= len(q) <= most
        assert len(q) == len(v) == len(tau)
        assert (model.nearness(q) > LEAST_NEARNESS).all()
        assert np.isfinite(model.forward_dynamics(q, v, tau)).all()


def test_text_holds_the_figures():
    text = transmission_report(Model("mit_humanoid_leg"), states=20)
    for words in ("12 knee_link + 12 ankle_link", "0.1041422", "0.0242510", "over 20 random states", "armature"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 140
    assert "random states" not in transmission_report(Model("mit_humanoid_leg"), states=0)


def test_a_robot_without_rotors_says_so():
    robot = geared_joint()
    bare = Robot("bare", robot.bodies[:1], (), ("link",))
    assert transmission_report(Model(bare)) == "bare has no rotors: all transmission levels are the same."


def geared_joint() -> Robot:
    def inertial(mass: float, moment: float) -> Inertial:
        return Inertial(mass, (0.0, 0.0, 0.0), ((moment, 0.0, 0.0), (0.0, moment, 0.0), (0.0, 0.0, moment)))

    joint = Joint("revolute", (0.0, 0.0, 1.0))
    link = Body("link", "link", None, Placement(), joint, inertial(1.0, 0.1))
    rotor = Body("rotor", "rotor", None, Placement(), joint, inertial(0.1, 2e-4))
    gear = LinearConstraint("gear", (("rotor", 1.0), ("link", -10.0)))
    return Robot("geared", (link, rotor), (gear,), ("link",))
