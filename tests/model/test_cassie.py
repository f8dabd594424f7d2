"""Cassie: rods that close, springs that no motor moves, feet on the ground, masses of the published file."""

from __future__ import annotations

import numpy as np
import pytest
from published import feet_above_ground

from ce_gym import LEVELS
from ce_gym.dynamics import Model
from ce_gym.envs.custom import missing
from ce_gym.model import load_robot
from ce_gym.model.constraints import RodConstraint
from ce_gym.sim import Simulator

SPRINGS = ("left_shin", "left_heel_spring", "right_shin", "right_heel_spring")


@pytest.fixture(scope="module")
def robot():
    return load_robot("cassie")


def test_it_stands_flat_on_its_feet_and_has_what_tasks_need(robot):
    assert not missing(robot)
    assert robot.total_mass == pytest.approx(33.312, abs=1e-9), "of the published file, rods counted"
    model = Model(robot)
    lowest, highest = feet_above_ground(model)
    assert lowest == pytest.approx(0.0, abs=1e-6)
    assert highest < 1e-6
    points = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    forward = {c.name: x for c, x in zip(robot.contacts, points[:, 0], strict=True)}
    assert forward["left_toe"] - forward["left_heel"] == pytest.approx(0.16, abs=1e-3)
    p, R = model.body_poses(model.standing_q)
    centres = [p[i] + R[i] @ robot.body(name).inertial.com for i, name in enumerate(model.body_names)]
    masses = [robot.body(name).inertial.mass for name in model.body_names]
    assert forward["left_heel"] < np.average(centres, axis=0, weights=masses)[0] < forward["left_toe"]


def test_springs_are_passive(robot):
    assert robot.passive == SPRINGS
    assert len(robot.driven) == len(robot.motors) == 10
    assert {robot.body(name).joint.stiffness for name in SPRINGS} == {1500.0, 1250.0}


def test_it_stands_without_a_policy(robot):
    """Ten seconds at the targets of its pose, from there and from up to 0.03 rad beside it, at every motor."""
    model = Model(robot)
    sim = Simulator(model, 8, outputs=())
    target, rng = model.standing_q[7:], np.random.default_rng(0)
    q = np.tile(model.standing_q, (8, 1))
    q[1:, [7 + model.joint_links.index(name) for name in robot.driven]] += rng.uniform(-0.03, 0.03, (7, 10))
    sim.set_state(q, np.zeros((8, model.nv)))
    sim.step(target, 2000)
    assert sim.q[:, 2].min() > 0.98 * model.standing_q[2] - 0.02
    assert np.abs(sim.q[:, 4:6]).max() < np.radians(7) / 2  # upright: it leans 3 degrees forward
    assert np.abs(sim.v).max() < 0.1


@pytest.mark.parametrize("level", LEVELS)
def test_rods_close_in_closed_form(robot, level):
    """Ends keep their distance to rounding, springs bent or not, without a guess that would be a state."""
    model, rng = Model(robot, level), np.random.default_rng(0)
    assert len(model.guess) == 0
    rods = [tie for tie in robot.constraints if isinstance(tie, RodConstraint)]
    assert len(rods) == 4
    row = {name: i for i, name in enumerate(model.body_names)}
    for _ in range(20):
        q = model.standing_q.copy()
        q[7:] += rng.uniform(-0.2, 0.2, len(q) - 7)
        p, R = model.body_poses(q)
        for rod in rods:
            first = p[row[rod.first]] + R[row[rod.first]] @ rod.first_point
            second = p[row[rod.second]] + R[row[rod.second]] @ rod.second_point
            assert np.linalg.norm(second - first) == pytest.approx(rod.length, abs=1e-12)


def test_left_and_right_are_mirrored_but_for_a_published_centre_of_mass(robot):
    """Hips' rolls have theirs 0.1 mm to the left on both sides; nothing else differs."""
    mirror = np.diag([1.0, 1.0, -1.0])
    for left in (body for body in robot.bodies if body.name.startswith("left_") and body.kind == "link"):
        right = robot.body(left.name.replace("left_", "right_"))
        assert right.inertial.mass == left.inertial.mass
        if left.name not in ("left_hip_roll", "left_hip_yaw"):  # their frames are mirrored along y
            np.testing.assert_allclose(right.inertial.com, mirror @ left.inertial.com, atol=1e-12)
            turned = mirror @ np.array(left.inertial.inertia) @ mirror
            np.testing.assert_allclose(right.inertial.inertia, turned, atol=1e-12)
