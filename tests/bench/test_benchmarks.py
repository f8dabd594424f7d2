"""The measuring code of the benchmarks on small cases; figures that do not depend on the machine."""

import argparse

import numpy as np
import pytest

from ce_gym.bench.paper import instructions, tracking
from ce_gym.model import load_robot

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def test_tracking_reproduces_the_published_torques():
    joints, exact, errors = tracking.torque_errors("mit_humanoid_leg")
    knee = joints.index("knee_link")
    assert exact.shape == (10001, 5)
    np.testing.assert_allclose(errors["none"], [0.288121, 0.266132, 0.989139, 4.309643, 1.587640], atol=1e-6)
    np.testing.assert_allclose(errors["armature"], [0.206002, 0.178213, 0.364711, 1.044559, 0.826307], atol=1e-6)
    assert errors["none"][knee] == pytest.approx(4.309643175251027, rel=1e-10)
    assert errors["armature"][knee] == pytest.approx(1.0445586158983378, rel=1e-10)
    assert np.abs(exact[:, knee]).max() == pytest.approx(11.229339, abs=1e-6)


def test_exactness_costs_no_more_than_required():
    """Gears, belts, rods; the command does all robots."""
    report = instructions.run(argparse.Namespace(robot=["mini_cheetah", "mit_humanoid_leg", "tello"]))
    assert {row[0] for row in report.tables[0].rows} == {"mini_cheetah", "mit_humanoid_leg", "tello"}
    assert len(report.requirements) == 3
    assert all(requirement.met for requirement in report.requirements), report.as_text()


def test_mujoco_stands_at_its_converged_settings_and_not_with_too_few_iterations():
    pytest.importorskip("mujoco")
    from ce_gym.bench.peers import mujoco_settings
    from ce_gym.bench.peers.stand import bare

    robot = bare(load_robot("mini_cheetah"), "foot")
    _, reference = mujoco_settings.watched(robot, "armature", mujoco_settings.Settings(0.001, "Euler"), 4)
    assert reference.like(reference)
    assert reference.contacts == 4.0
    settings = mujoco_settings.Settings(0.005, "Euler", "Newton", 1, 4)
    _, hasty = mujoco_settings.watched(robot, "armature", settings, 4)
    assert not hasty.like(reference)


def test_ours_stands_like_mujoco():
    pytest.importorskip("mujoco")
    from ce_gym.bench.peers import mujoco_settings, stand
    from ce_gym.dynamics.model import Model
    from ce_gym.sim import Simulator

    robot = stand.bare(load_robot("mini_cheetah"), "foot")
    settings = mujoco_settings.Settings(0.001, "Euler", solimp=mujoco_settings.STIFF)
    _, reference = mujoco_settings.watched(robot, "exact", settings, 4)
    ours = stand.watch_ours(Simulator(Model(robot, "exact"), num_envs=4), robot)
    assert ours.like(reference)
    assert ours.contacts == 4.0
    assert ours.height == pytest.approx(reference.height, abs=0.05)
