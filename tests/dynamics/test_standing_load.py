"""The load in the standing pose, and the tables and findings that `inspect` prints of a robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ce_gym.diagnostics.robot import axis_text, findings, robot_report
from ce_gym.dynamics import Model
from ce_gym.dynamics.standing import standing_pose
from ce_gym.dynamics.standing_load import load_of, placeholders
from ce_gym.model import load_robot
from ce_gym.model.description import Joint, Robot


def with_joint(robot: Robot, name: str, **changes: object) -> Robot:
    def changed(joint: Joint) -> Joint:
        return replace(joint, **changes)  # type: ignore[arg-type]

    return replace(
        robot, bodies=tuple(replace(b, joint=changed(b.joint)) if b.name == name else b for b in robot.bodies)
    )


def found(robot: Robot) -> list[str]:
    model = Model(robot)
    standing = standing_pose(model.mechanism)
    feet = [c for c in robot.contacts if c.group == "foot"]
    return list(findings(model, standing, load_of(model.mechanism, standing, feet)))


@pytest.mark.parametrize("name", ["mini_cheetah", "berkeley_humanoid"])
def test_load_is_gravity_minus_the_forces_at_the_feet(name):
    """The compiled quantities of `Model` share no code with the mass matrix and Jacobians of the standing pose."""
    model = Model(name)
    q, robot = model.standing_q, model.robot
    feet = [i for i, c in enumerate(robot.contacts) if c.group == "foot"]
    load = load_of(model.mechanism, standing_pose(model.mechanism), [robot.contacts[i] for i in feet])
    g, J = model.gravity_force(q), model.contact_jacobian(q)[feet].reshape(-1, model.nv)
    forces = np.linalg.pinv(J[:, :6].T) @ g[:6]
    tau = g - J.T @ forces
    assert np.abs(tau[:6]).max() < 1e-9, "the feet carry the weight"
    rows = {joint: robot.rows[joint][1][0] for joint in robot.independent}
    assert load.torques == pytest.approx({joint: tau[row] for joint, row in rows.items()}, abs=1e-9)
    M = model.mass_matrix(q)
    assert load.inertias == pytest.approx({joint: M[row, row] for joint, row in rows.items()}, rel=1e-9)
    assert load.weight == pytest.approx(9.81 * robot.total_mass)
    lowest = min(c.lowest_point(*pose) for c, pose in zip(robot.contacts, contact_poses(model), strict=True))
    assert load.height == pytest.approx(model.center_of_mass(q)[2] - lowest)


def contact_poses(model):
    positions, rotations = model.body_poses(model.standing_q)
    index = [model.body_names.index(c.body) for c in model.robot.contacts]
    return [(positions[i], rotations[i]) for i in index]


def test_tables_show_limits_gains_and_heights():
    text = robot_report(Model("mini_cheetah"))
    row = next(line for line in text.splitlines() if line.split()[:1] == ["FL_knee"] or "FL_knee" in line)
    assert "20" in row.split()
    assert "0.5" in row.split()
    assert "Findings: none" in text
    assert (axis_text(np.array([0.0, -1.0, 0.0])), axis_text(np.array([0.6, 0.0, -0.8]))) == ("-y", "0.60 0.00 -0.80")


def test_findings_name_what_is_wrong():
    robot = load_robot("mini_cheetah")
    joint = robot.independent[0]
    assert found(robot) == []
    assert placeholders(robot, load_of(*_load_arguments(robot))) == []
    (line,) = found(with_joint(robot, joint, torque=1000.0))
    assert line.startswith("torque limits like placeholders (1000)")
    assert robot.joint_name(joint) in line
    (line,) = found(with_joint(robot, joint, torque=1e-3))
    assert line.startswith("torque limits below the load")
    undamped = tuple((name, 0.0 if name == joint else kd) for name, kd in robot.gains.kd)
    (line,) = found(replace(with_joint(robot, joint, damping=0.0), gains=replace(robot.gains, kd=undamped)))
    assert line == f"no velocity gain and no damping: {robot.joint_name(joint)}"
    (line,) = found(replace(robot, contacts=tuple(c for c in robot.contacts if c.group != "torso")))
    assert line.startswith("no contact of group torso")
    heavy = replace(robot.bodies[1], inertial=replace(robot.bodies[1].inertial, mass=3.0))
    (line,) = found(replace(robot, bodies=(robot.bodies[0], heavy, *robot.bodies[2:])))
    assert line.startswith("left and right differ in mass")
    assert robot.bodies[1].name in line
    bent = {**dict(robot.pose.joints), robot.independent[2]: -1.2}
    lines = found(replace(robot, pose=replace(robot.pose, joints=tuple(bent.items()))))
    assert any(line.startswith("feet off the ground") for line in lines)


def _load_arguments(robot):
    model = Model(robot)
    return model.mechanism, standing_pose(model.mechanism), [c for c in robot.contacts if c.group == "foot"]
