"""Robots that people have, by published figures: MuJoCo reads the same URDF, and finds the same robot at `armature`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.envs.custom import missing
from ce_gym.model import load_robot
from ce_gym.model.mechanism import LEVELS

LEGS = ("FL", "FR", "RL", "RR")
GO = 1.11842e-4 * 6.33**2
BERKELEY = {"hr": 6.9e-5, "haa": 6.9e-5, "hfe": 9.4e-5, "kfe": 1.5e-4, "ffe": 6.9e-5, "faa": 6.1e-6}
ROBOTS = {
    "go1": (13.100528, {"hip": GO, "thigh": GO, "calf": GO * 1.5**2}, LEGS),
    "go2": (16.087, {"hip": GO, "thigh": GO, "calf": GO * 1.917**2}, LEGS),
    "berkeley_humanoid": (16.0567651, {joint: 81 * J for joint, J in BERKELEY.items()}, ("ll", "lr")),
}
"""Mass [kg], reflected inertia of a leg's joints [kg m^2], legs."""


@pytest.mark.parametrize("name", ROBOTS)
def test_mujoco_finds_the_same_mass_matrix_and_accelerations(name, tmp_path):
    pytest.importorskip("mujoco")
    from mujoco_peer import compare

    robot = load_robot(name)
    text = Path(robot.source).with_suffix(".urdf").read_text()
    ends = f'<parent link="w"/><child link="{robot.bodies[0].name}"/>'
    base = f'<link name="w"/><joint name="b" type="floating">{ends}</joint>'
    (tmp_path / "free.urdf").write_text(text.replace("</robot>", f"{base}</robot>"))
    armature = {f"{leg}_{joint}": value for leg in ROBOTS[name][2] for joint, value in ROBOTS[name][1].items()}
    assert set(armature) == set(robot.independent)
    compare(tmp_path / "free.urdf", robot, "armature", armature=armature)


@pytest.mark.parametrize("name", ROBOTS)
def test_it_stands_on_its_feet_and_has_what_tasks_need(name):
    robot = load_robot(name)
    assert not missing(robot)
    assert robot.total_mass == pytest.approx(ROBOTS[name][0], abs=1e-6)
    assert len(robot.motors) == len(list(robot.rotors())) == len(robot.independent) == 12
    assert all(np.isfinite(motor.torque) and np.isfinite(motor.velocity) for motor in robot.motors)
    model = Model(robot)
    points = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    under = {c.name: z - c.radius for c, z in zip(robot.contacts, points[:, 2], strict=True)}
    feet = [under[contact.name] for contact in robot.contacts if contact.group == "foot"]
    assert min(feet) == pytest.approx(0.0, abs=1e-6)
    assert max(feet) < 3e-4
    assert min(under[contact.name] for contact in robot.contacts if contact.group != "foot") > 0.05


@pytest.mark.parametrize("name", ROBOTS)
def test_levels_differ_in_what_rotors_do(name):
    robot = load_robot(name)
    models = {level: Model(robot, level) for level in LEVELS}
    q = models["exact"].standing_q
    M = {level: model.mass_matrix(q) for level, model in models.items()}
    assert np.linalg.eigvalsh(M["exact"])[0] > 0.0
    assert np.abs(M["coupled"] - M["armature"]).max() < 1e-12, "every gear drives one joint"
    reflected = {f"{leg}_{joint}": J for leg in ROBOTS[name][2] for joint, J in ROBOTS[name][1].items()}
    added = np.diag(M["armature"] - M["none"])[6:]
    np.testing.assert_allclose(added, [reflected[joint] for joint in robot.independent], rtol=1e-6)
    assert np.abs(M["exact"] - M["armature"])[:6, 6:].max() > 1e-4, "rotors couple to the base"
