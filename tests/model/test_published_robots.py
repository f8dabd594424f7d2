"""Robots that people have, by published figures: MuJoCo reads the same URDF, and finds the same robot at `armature`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from published import above_ground, feet_above_ground

from ce_gym.dynamics import Model
from ce_gym.envs.custom import missing
from ce_gym.model import load_robot
from ce_gym.model.mechanism import LEVELS

LEGS = ("FL", "FR", "RL", "RR")
SIDES = ("left", "right")
GO = 1.11842e-4 * 6.33**2
GEARED = GO * (20 / 9) ** 2
M107 = {15: 0.063259741, 24: 0.160478022}
BERKELEY = {"hr": 6.9e-5, "haa": 6.9e-5, "hfe": 9.4e-5, "kfe": 1.5e-4, "ffe": 6.9e-5, "faa": 6.1e-6}
H1 = {
    **dict.fromkeys(("hip_yaw", "hip_roll", "hip_pitch"), M107[15]),
    "knee": M107[24],
    **dict.fromkeys(("ankle", "shoulder_pitch", "shoulder_roll"), GEARED),
    **dict.fromkeys(("shoulder_yaw", "elbow"), GO),
}


T1 = {
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll", "elbow_pitch", "elbow_yaw"), 0.0282528),
    **{"hip_pitch": 0.0523908, "hip_roll": 0.0478125, "hip_yaw": 0.0478125, "knee_pitch": 0.0636012},
    **{"ankle_pitch": 0.0407621, "ankle_roll": 0.0111713},
}


def limbs(names: tuple[str, ...], joints: dict[str, float]) -> dict[str, float]:
    """The same figures of joints for each limb."""
    return {f"{name}_{joint}": value for name in names for joint, value in joints.items()}


ROBOTS = {
    "go1": (13.100528, limbs(LEGS, {"hip": GO, "thigh": GO, "calf": GO * 1.5**2})),
    "go2": (16.087, limbs(LEGS, {"hip": GO, "thigh": GO, "calf": GO * 1.917**2})),
    "anymal_c": (52.13485, limbs(("LF", "RF", "LH", "RH"), dict.fromkeys(("HAA", "HFE", "KFE"), 0.06))),
    "h1": (59.338, limbs(SIDES, H1) | {"torso": M107[15]}),
    "t1": (31.7343578, limbs(SIDES, T1) | {"waist": 0.0478125, "head_yaw": 0.0018, "head_pitch": 0.0018}),
    "berkeley_humanoid": (16.0567651, limbs(("ll", "lr"), {joint: 81 * J for joint, J in BERKELEY.items()})),
}
"""Mass [kg], published armature of joints [kg m^2]."""


def free(robot, folder: Path) -> Path:
    """Write the robot's URDF, less what has no mass, on a floating joint, for MuJoCo."""
    text = Path(robot.source).with_suffix(".urdf").read_text()
    text = re.sub(
        r'  <link name="\w+_(crank_\d|nut)">.*?</link>\n|  <joint name="\w+_(crank_\d|nut)_joint".*?</joint>\n',
        "",
        text,
        flags=re.S,
    )
    ends = f'<parent link="w"/><child link="{robot.bodies[0].name}"/>'
    base = f'<link name="w"/><joint name="b" type="floating">{ends}</joint>'
    path = folder / "free.urdf"
    path.write_text(text.replace("</robot>", f"{base}</robot>"))
    return path


@pytest.mark.parametrize("name", ROBOTS)
def test_mujoco_finds_the_same_mass_matrix_and_accelerations(name, tmp_path):
    pytest.importorskip("mujoco")
    from mujoco_peer import compare

    robot = load_robot(name)
    assert set(ROBOTS[name][1]) == set(robot.independent)
    compare(free(robot, tmp_path), robot, "armature", armature=ROBOTS[name][1])


@pytest.mark.parametrize("name", ROBOTS)
def test_it_stands_on_its_feet_and_has_what_tasks_need(name):
    robot = load_robot(name)
    assert not missing(robot)
    assert robot.total_mass == pytest.approx(ROBOTS[name][0], abs=1e-6)
    assert len(robot.motors) == len(list(robot.rotors())) == len(robot.independent) == len(ROBOTS[name][1])
    assert all(np.isfinite(motor.torque) and np.isfinite(motor.velocity) for motor in robot.motors)
    model = Model(robot)
    lowest, highest = feet_above_ground(model)
    assert lowest == pytest.approx(0.0, abs=1e-6)
    assert highest < 3e-4
    under = above_ground(model)
    assert min(under[contact.name] for contact in robot.contacts if contact.group != "foot") > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_levels_differ_in_what_rotors_do(name):
    robot = load_robot(name)
    models = {level: Model(robot, level) for level in LEVELS}
    q = models["exact"].standing_q
    M = {level: model.mass_matrix(q) for level, model in models.items()}
    assert np.linalg.eigvalsh(M["exact"])[0] > 0.0
    assert np.abs(M["coupled"] - M["armature"]).max() < 1e-12, "every gear drives one joint, or two by turns"
    added = np.diag(M["armature"] - M["none"])[6:]
    np.testing.assert_allclose(added, [ROBOTS[name][1][joint] for joint in robot.independent], rtol=1e-6)
    assert np.abs(M["exact"] - M["armature"])[:6, 6:].max() > 1e-4, "rotors couple to the base"


G1_MOTORS = {"5020": 1.410049e-5 * 16**2, "7520_14": 4.964394e-5 * 14.318182**2, "7520_22": 4.958405e-5 * 22.5**2}
"""Reflected inertias [kg m^2], which mjlab gives as 0.00361, 0.01018 and 0.02510."""
G1_LEG = {"hip_pitch": "7520_14", "hip_roll": "7520_22", "hip_yaw": "7520_14", "knee": "7520_22"}


def test_g1_s_motors_turn_ankles_through_rods_and_all_others_directly():
    robot = load_robot("g1")
    models = {level: Model(robot, level) for level in LEVELS}
    exact = models["exact"]
    q, at = exact.standing_q, exact.joint_links
    added = (models["armature"].mass_matrix(q) - models["none"].mass_matrix(q))[6:, 6:]
    for side in SIDES:
        for joint, motor in G1_LEG.items():
            row = at.index(f"{side}_{joint}")
            assert added[row, row] == pytest.approx(G1_MOTORS[motor], rel=1e-6)
        rows = [at.index(f"{side}_ankle_{axis}") for axis in ("pitch", "roll")]
        step, cranks = 1e-6, []
        for row in rows:  # by differences of the closed loop
            ends = [
                exact.spanning(q + sign * step * np.eye(len(q))[7 + row], np.zeros(exact.nv))[0] for sign in (1, -1)
            ]
            columns = [1 + 6 + exact.spanning_names.index(f"{side}_ankle_crank_{i}") for i in (1, 2)]
            cranks.append((ends[0] - ends[1])[columns] / (2 * step))
        reflected = np.array(cranks) @ np.array(cranks).T * G1_MOTORS["5020"]
        np.testing.assert_allclose(np.diag(added)[rows], np.diag(reflected), rtol=1e-6)
    assert [added[at.index(name), at.index(name)] for name in ("torso", "waist_roll")] == pytest.approx(
        [2 * G1_MOTORS["5020"]] * 2
    )


@pytest.mark.parametrize(("name", "mass"), [("g1", 33.341142), ("spot", 50.34)])
def test_mujoco_finds_robots_with_rods_without_their_rotors(name, mass, tmp_path):
    pytest.importorskip("mujoco")
    from mujoco_peer import compare

    robot = load_robot(name)
    assert robot.total_mass == pytest.approx(mass, abs=1e-6)
    assert not missing(robot)
    compare(free(robot, tmp_path), robot, "none", spread=0.1)


SPOT_KNEE = {
    -2.7929: 24.776718,
    -2.411030: 46.174873,
    -2.003702: 64.346268,
    -1.596374: 74.496147,
    -1.443626: 75.490677,
    -1.189046: 73.107742,
    -0.781718: 58.139503,
    -0.247100: 20.401667,
}
"""Published turns of the motor for one of the knee, by the knee's angle [rad]: Isaac Lab's spot.py."""


def test_spot_s_screws_and_rods_have_the_published_ratios():
    models = {level: Model("spot", level) for level in ("exact", "armature", "none")}
    model = models["exact"]
    assert not len(model.guess), "a rod that ends on a slider has a formula"
    legs = [name.removesuffix("_kn") for name in model.joint_links if name.endswith("_kn")]
    knees = [6 + model.joint_links.index(f"{leg}_kn") for leg in legs]
    nuts = [6 + model.spanning_names.index(f"{leg}_nut") for leg in legs]
    for angle, ratio in SPOT_KNEE.items():
        q, v = model.standing_q, np.zeros(model.nv)
        q[[1 + knee for knee in knees]], v[knees] = angle, 1.0
        turns = 2 * np.pi / 3e-3 * model.spanning(q, v)[1][nuts]
        np.testing.assert_allclose(np.abs(turns), ratio, atol=2e-5)
        added = np.diag(models["armature"].mass_matrix(q) - models["none"].mass_matrix(q))
        np.testing.assert_allclose(added[knees], 1.41e-5 * ratio**2, rtol=2e-6)


def test_g1_s_ankles_close_over_their_whole_range():
    model = Model("g1")
    limits = {name: model.robot.body(name).joint.position for name in model.joint_links}
    for pitch in np.linspace(*limits["left_ankle_pitch"], 9):
        for roll in np.linspace(*limits["left_ankle_roll"], 9):
            q = model.standing_q
            q[[7 + model.joint_links.index(f"left_ankle_{axis}") for axis in ("pitch", "roll")]] = pitch, roll
            angles = dict(zip(model.spanning_names, model.spanning(q, np.zeros(model.nv))[0][7:], strict=True))
            cranks = [angles[f"left_ankle_crank_{i}"] for i in (1, 2)]
            assert np.abs(cranks).max() < 1.4  # a crank in line with its rod moves nothing
