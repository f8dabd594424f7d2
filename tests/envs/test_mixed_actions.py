"""Actions of different kinds on one robot: a cart with two driven wheels and a mast with position control."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import ce_gym  # noqa: F401 - registers the environments
from ce_gym.envs.policy_spec import policy_spec
from ce_gym.envs.runtime.setup import make_program
from ce_gym.model import RobotError

RADIUS, SPEED, KP, KD, KD_WHEEL = 0.1, 30.0, 20.0, 0.5, 0.4
I_BASE, I_MAST, I_WHEEL = 0.08, 0.01, 0.002  # about y; the mast's is the same about all axes
ACTIONS = {"*": "joint_pd", "*wheel*": "joint_velocity"}


def link(name: str, mass: float, moments: tuple[float, float, float]) -> str:
    x, y, z = moments
    inertia = f'<mass value="{mass}"/><inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial>{inertia}</inertial></link>'


def joint(name: str, child: str, axis: str, xyz: str, effort: float) -> str:
    limit = f'<limit lower="-3" upper="3" effort="{effort}" velocity="{SPEED}"/>' if child == "mast" else ""
    limit = limit or f'<limit effort="{effort}" velocity="{SPEED}"/>'
    kind = "revolute" if child == "mast" else "continuous"
    return (
        f'<joint name="{name}" type="{kind}"><parent link="base"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def cart(folder: Path, effort: float = 50.0, gains: str = "", casters: bool = False) -> str:
    """Write a cart whose centres of mass are all on the axis of its wheels; return the path of its file."""
    parts = [
        link("base", 4.0, (0.06, I_BASE, 0.06)),
        link("mast", 1.0, (I_MAST,) * 3),
        link("left", 0.5, (0.0015, I_WHEEL, 0.0015)),
        link("right", 0.5, (0.0015, I_WHEEL, 0.0015)),
        joint("mast_yaw", "mast", "0 0 1", "0 0 0", effort),
        joint("left_wheel", "left", "0 1 0", "0 0.2 0", effort),
        joint("right_wheel", "right", "0 1 0", "0 -0.2 0", effort),
    ]
    (folder / "cart.urdf").write_text(f'<robot name="cart">{"".join(parts)}</robot>')
    gains = gains or f"{{kp: {{mast_yaw: {KP}}}, kd: {{mast_yaw: {KD}, '*_wheel': {KD_WHEEL}}}}}"
    shape = f"shape: cylinder, size: [{RADIUS}, 0.04], rpy: [1.5707963267948966, 0, 0], rolls: true, group: foot"
    ball = f"body: base, radius: 0.02, position: [{{}}, 0, {0.02 - RADIUS}]"
    contacts = [f"left: {{body: left, {shape}}}", f"right: {{body: right, {shape}}}"]
    contacts += [f"ball{i}: {{{ball.format(x)}, group: foot}}" for i, x in enumerate((0.2, -0.2)) if casters]
    contacts.append("top: {body: base, position: [0, 0, 0.2], radius: 0.02, group: torso}")
    text = f"urdf: cart.urdf\nbase: floating\ngains: {gains}\npose: {{height: {RADIUS}}}\ncontacts:\n"
    (folder / "cart.yaml").write_text(text + "".join(f"  {contact}\n" for contact in contacts))
    return str(folder / "cart.yaml")


def make(robot: str, **arguments: Any) -> Any:
    still = dict.fromkeys(("joint_position", "joint_velocity", "base_velocity"), 0.0)
    arguments = {"actions": ACTIONS, "reset_noise": still, "robot": robot, **arguments}
    envs = gymnasium.make_vec("ce_gym/MiniCheetahVelocity-v0", 1, **arguments).unwrapped
    envs.reset(seed=0)
    return envs


@pytest.mark.parametrize(
    ("effort", "dt", "gains"),
    [(50.0, 0.005, ""), (0.1, 0.005, ""), (50.0, 0.001, ""), (50.0, 0.005, f"{{kp: 20, kd: {KD_WHEEL}}}")],
)
def test_torques_of_wheels_in_the_air(tmp_path, effort: float, dt: float, gains: str):
    """With `tau = kd (target - v)` at the end of the step, within the limit, and `v' = tau (1 / I + 2 / I_base)`.

    Both wheels turn about an axis through the common centre of mass, so gravity does not matter. A position gain of the
    wheels does not matter either.
    """
    envs = make(cart(tmp_path, effort, gains), contacts=[], n_substeps=1, dt=dt)
    wheels = [i for i, name in enumerate(envs.policy_spec()["joints"]) if "wheel" in name]
    action, speed, per_torque = np.zeros((1, 3), np.float32), 0.0, 1 / I_WHEEL + 2 / (I_BASE + I_MAST)
    action[0, wheels] = 0.25
    for _ in range(round(0.06 / dt)):
        envs.step(action)
        torque = KD_WHEEL * (0.25 * SPEED - speed) / (1 + dt * KD_WHEEL * per_torque)
        torque = np.clip(torque, -effort, effort)
        speed += dt * torque * per_torque
        np.testing.assert_allclose(envs.batch.rows("torque")[0, wheels], torque, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(envs.state()["v"][0, 6:][wheels], speed, rtol=1e-9)
    assert (speed > 0.9 * 0.25 * SPEED) == (effort > 1)


def test_torque_of_the_mast_beside_wheels_at_rest(tmp_path):
    """With `tau = kp (target - y) - kd v` at the end of the step, and `v' = tau (1 / I + 1 / I_rest)` about z."""
    dt = 0.005
    envs = make(cart(tmp_path), contacts=[], n_substeps=1, dt=dt)
    mast = envs.policy_spec()["joints"].index("mast_yaw")
    action, angle, rate = np.zeros((1, 3), np.float32), 0.0, 0.0
    action[0, mast] = 0.5
    per_torque, damping = 1 / I_MAST + 1 / (0.06 + 2 * (0.0015 + 0.5 * 0.2**2)), KD + dt * KP
    for _ in range(12):
        envs.step(action)
        torque = (KP * (0.5 * 0.5 - angle) - damping * rate) / (1 + dt * damping * per_torque)
        rate += dt * torque * per_torque
        angle += dt * rate
        assert envs.batch.rows("torque")[0, mast] == pytest.approx(torque, rel=1e-7)
        assert np.abs(np.delete(envs.batch.rows("torque")[0], mast)).max() < 1e-9


def test_it_drives(tmp_path):
    """At the speed of its wheels times their radius, in a circle if they differ; `kd (target - v)` beats friction."""
    envs = make(cart(tmp_path, casters=True), contacts=["foot"])
    names = list(envs.policy_spec()["joints"])
    action = np.zeros((1, 3), np.float32)
    action[0, [names.index("left_wheel"), names.index("right_wheel")]] = 0.2, 0.3
    for _ in range(100):
        envs.step(action)
    v, torque = envs.state()["v"][0], envs.batch.rows("torque")[0]
    left, right = (6 + names.index(name) for name in ("left_wheel", "right_wheel"))
    assert v[3] == pytest.approx(RADIUS * (v[left] + v[right]) / 2, rel=0.03)
    assert v[2] == pytest.approx(RADIUS * (v[right] - v[left]) / 0.4, rel=0.03)
    np.testing.assert_allclose(torque[left - 6], KD_WHEEL * (0.2 * SPEED - v[left]), rtol=1e-6)
    assert v[3] > 0.5
    assert v[2] > 0.4


def test_late_actions_keep_their_kinds(tmp_path):
    robot = cart(tmp_path)
    plain, late = make(robot, contacts=[]), make(robot, contacts=[], latency=(4, 4))
    held = np.zeros((1, 3), np.float32)
    for k in range(4):
        action = np.random.default_rng(k).uniform(-1, 1, (1, 3)).astype(np.float32)
        late.step(action)
        plain.step(held)
        held = action
        np.testing.assert_allclose(late.state()["q"], plain.state()["q"], atol=1e-10)


def test_the_specification_of_mixed_actions(tmp_path):
    program = make_program(cart(tmp_path), "velocity", actions=ACTIONS, action_scale=0.3)
    spec = policy_spec(program, "velocity")
    action, wheel = spec["action"], ["joint_velocity", SPEED]
    entries = {name: entry for name, *entry in zip(*(action[key] for key in ("joints", "kinds", "scale")), strict=True)}
    assert entries == {"mast_yaw": ["joint_pd", 0.3], "left_wheel": wheel, "right_wheel": wheel}
    assert spec["action"]["kind"] == "mixed"
    assert dict(zip(spec["joints"], spec["kp"], strict=True)) == {"mast_yaw": KP, "left_wheel": 0, "right_wheel": 0}
    assert dict(zip(spec["joints"], spec["kd"], strict=True))["left_wheel"] == KD_WHEEL


def test_actions_in_the_file_of_a_robot(tmp_path):
    robot = Path(cart(tmp_path))
    tasks = "tasks: {velocity: {actions: {'*': joint_pd, '*_wheel': joint_velocity}}}\n"
    robot.write_text(robot.read_text() + tasks)
    actions = make_program(str(robot), "velocity").actions
    kinds = dict(zip(actions.targets, actions.kinds, strict=True))
    assert kinds == {"mast": "joint_pd", "left": "joint_velocity", "right": "joint_velocity"}


def test_torques_beside_positions_are_torques(tmp_path):
    envs = make(cart(tmp_path), contacts=[], actions={"*": "joint_torque", "mast": "joint_pd"}, n_substeps=1)
    names = list(envs.policy_spec()["joints"])
    action = np.zeros((1, 3), np.float32)
    action[0, names.index("left_wheel")] = 0.1
    envs.step(action)
    torque = dict(zip(names, envs.batch.rows("torque")[0], strict=True))
    assert torque["left_wheel"] == pytest.approx(0.1 * 50.0)
    assert torque["right_wheel"] == 0.0


def test_uniform_velocities_and_uniform_mappings(tmp_path):
    robot = cart(tmp_path, gains="{kd: 0.4}")
    actions = make_program(robot, "velocity", actions="joint_velocity").actions
    assert (actions.control, actions.kinds) == ("position", ["joint_velocity"] * 3)
    actions = make_program(robot, "velocity", actions={"*": "joint_torque"}).actions
    assert (actions.control, actions.joint_control) == ("torque", ())


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"*_wheel": "joint_velocity"}, r"actions: \*_wheel; expected a pattern for every joint, here mast_yaw"),
        ({"*": "joint_pd", "arm": "joint_pd"}, "actions='arm'; expected patterns of joints among mast_yaw"),
        ({"*": "motor_pd"}, r"actions\['\*'\].*'motor_pd'.*joint_pd"),
        ({}, "actions={}; expected at least one pattern of joints"),
        ({"*": "joint_pd"}, "gains.kp.left_wheel is missing: expected a gain above 0 for actions 'joint_pd'"),
    ],
)
def test_mistakes(tmp_path, actions: dict[str, str], message: str):
    with pytest.raises((ValueError, RobotError), match=message):
        make_program(cart(tmp_path), "velocity", actions=actions)


@pytest.mark.parametrize(
    ("gains", "missing"),
    [("{kp: 20, kd: {mast_yaw: 1}}", "kd.left_wheel"), ("{kp: {'*': 20, mast_yaw: 0}, kd: 1}", "kp.mast_yaw is 0.0")],
)
def test_gains_that_are_forgotten(tmp_path, gains: str, missing: str):
    robot = cart(tmp_path, gains=gains)
    with pytest.raises(RobotError, match=f"gains.{missing}.*: expected a gain above 0"):
        make_program(robot, "velocity")
    make_program(cart(tmp_path, gains="{kp: 20}"), "velocity")
    make_program(cart(tmp_path, gains="{kp: 20, kd: 0}"), "velocity")
