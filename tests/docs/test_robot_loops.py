"""The loops for robots, in numpy and in C, act as the package does and walk in MuJoCo; needs no robot."""

from __future__ import annotations

import runpy
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.export.mjcf import to_mjcf
from ce_gym.policies import Actor, export_policy, load_policy, save

FOLDER = Path(__file__).parents[2] / "docs" / "examples"
SHIPPED = "mini_cheetah_deployable"
PolicyLoop: Any = runpy.run_path(str(FOLDER / "robot_loop.py"))["PolicyLoop"]
MEASURED = ("quaternion", "gyro", "command", "positions", "velocities")


@contextmanager
def numpy_loop(policy: Any, folder: Path, names: list[str]) -> Iterator[Any]:
    export_policy(policy, folder / "walk.npz")
    loop = PolicyLoop(folder / "walk.npz", names)
    yield lambda stamp, **measured: loop.step(stamp, **measured, now=stamp)


@contextmanager
def c_loop(policy: Any, folder: Path, names: list[str]) -> Iterator[Any]:
    """Compile the loop with a policy; yield a function that measures through its pipe."""
    compiler = shutil.which("cc") or pytest.skip("needs a C compiler")
    export_policy(policy, folder / "policy.h")
    shutil.copy(FOLDER / "robot_loop.c", folder)
    options = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "robot_loop.c", "-o", "loop", "-lm"]
    subprocess.run([compiler, *options], cwd=folder, check=True)
    process = subprocess.Popen([folder / "loop"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with process as running:
        assert running.stdin
        assert running.stdout
        print(*names, file=running.stdin)
        lines = running.stdout

        def step(stamp: float, **measured: Any) -> Any:
            print(stamp, *(x for key in MEASURED for x in measured[key]), file=running.stdin, flush=True)
            return np.array(lines.readline().split(), float)

        yield step
        running.stdin.close()


LOOPS = pytest.mark.parametrize("loop", [numpy_loop, c_loop])


def random_policy(folder: Path, env_id: str, activation: str) -> Path:
    """Save a policy with deployable observations, a history and a normalisation."""
    mode = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    envs = gymnasium.make_vec(env_id, 1, vectorization_mode=mode, observations="deployable", history=2)
    (n,), (m,), rng = envs.single_observation_space.shape, envs.single_action_space.shape, np.random.default_rng(0)
    layers = tuple((rng.standard_normal((a, b)) / 8, rng.standard_normal(a) / 8) for a, b in ((20, n), (m, 20)))
    rows = np.stack([0.1 * rng.standard_normal(n), rng.uniform(0.5, 1.5, n), np.full(n, 2.0)])
    return save(Actor(layers, activation, rows), envs, folder / "walk_here.npz")


def shuffled(spec: dict[str, Any]) -> tuple[list[str], list[int]]:
    """Return the joints of a specification with one more, in another order, and the places of those of the policy."""
    names = list(np.random.default_rng(1).permutation([*spec["joints"], "tail"]))
    return names, [names.index(name) for name in spec["joints"]]


@LOOPS
@pytest.mark.parametrize(
    ("env_id", "activation"),
    [
        ("ce_gym/MiniCheetahVelocity-v0", ""),
        ("ce_gym/MitHumanoidVelocity-v0", "ELU"),
        ("ce_gym/Go2Velocity-v0", "ReLU"),
    ],
)
def test_loops_act_as_the_package(loop, env_id, activation, tmp_path):
    policy = load_policy(random_policy(tmp_path, env_id, activation) if activation else SHIPPED)
    envs: Any = gymnasium.make_vec(env_id, 1, **policy.record["env_kwargs"]).unwrapped
    observation, _ = envs.reset(seed=0)
    spec = envs.policy_spec()
    names, places = shuffled(spec)
    moved = [spec["joints"].index(name) for name in spec["action"]["joints"]]
    given, dt, largest = tmp_path / "walk_here.npz" if activation else SHIPPED, spec["control_dt"], 0.0
    with loop(given, tmp_path, names) as step:
        for k in range(20):
            state = envs.state()
            q, v = state["q"][0], state["v"][0]
            joints = [np.zeros(len(names)), np.zeros(len(names))]
            joints[0][places], joints[1][places] = q[-len(places) :], v[-len(places) :]
            measured = {"quaternion": q[3:7], "gyro": v[:3], "command": state["command"][0]}
            targets = step(k * dt, **measured, positions=joints[0], velocities=joints[1])
            action = policy.predict(observation)[0]
            expected = np.array(spec["default_pose"])
            expected[moved] += np.array(spec["action"]["scale"]) * action[0]
            np.testing.assert_allclose(targets[places], expected, rtol=0, atol=1e-5)
            assert np.isnan(targets[names.index("tail")])
            largest = max(largest, float(np.abs(action).max()))
            observation, *_ = envs.step(action)
    assert largest > 0.1


class MujocoRobot:
    """A robot whose joints have an order of its own, whose sensors are noisy, and whose commands take time."""

    def __init__(self, spec: dict[str, Any], delay: float, seed: int) -> None:
        import mujoco

        from ce_gym.export.mujoco_twin import set_contact_material

        self.mujoco, self.spec, self.rng = mujoco, spec, np.random.default_rng(seed)
        description = ce_gym.load_robot(spec["robot"])
        self.model = mujoco.MjModel.from_xml_string(to_mjcf(description, "armature"))
        self.model.opt.timestep, self.model.opt.integrator = 0.001, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        set_contact_material(self.model, description)
        self.state = mujoco.MjData(self.model)
        self.names = list(self.rng.permutation(spec["joints"]))
        joints = [self.model.joint(name).id for name in self.names]
        self.positions, self.velocities = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        driven = self.model.actuator_trnid[:, 0].tolist()
        self.motors = [driven.index(joint) for joint in joints]
        pose = dict(zip(spec["joints"], spec["default_pose"], strict=True))
        self.state.qpos[2], self.state.qpos[self.positions] = spec["standing_height"], [pose[x] for x in self.names]
        self.pending = [(0.0, np.array([pose[x] for x in self.names]))]
        self.delay = delay

    def measure(self) -> dict[str, Any]:
        noise, qpos, qvel = self.rng.uniform, self.state.qpos, self.state.qvel
        n = len(self.names)
        quaternion = qpos[3:7] + noise(-0.01, 0.01, 4)
        return {
            "quaternion": quaternion / np.linalg.norm(quaternion),
            "gyro": qvel[3:6] + noise(-0.1, 0.1, 3),
            "positions": qpos[self.positions] + noise(-0.01, 0.01, n),
            "velocities": qvel[self.velocities] + noise(-0.5, 0.5, n),
        }

    def command(self, targets: Any) -> None:
        """Send targets, which arrive after the delay, and go on for a control step."""
        self.pending.append((self.state.time + self.delay, targets))
        for _ in range(round(self.spec["control_dt"] / self.model.opt.timestep)):
            while len(self.pending) > 1 and self.pending[1][0] <= self.state.time + 1e-9:
                self.pending.pop(0)
            self.state.ctrl[self.motors] = self.pending[0][1]
            self.mujoco.mj_step(self.model, self.state)


@LOOPS
@pytest.mark.parametrize("policy", [SHIPPED, "go2_deployable"])
def test_loops_walk_in_mujoco_with_delay_and_noise(loop, policy, tmp_path):
    pytest.importorskip("mujoco")
    spec = export_policy(policy, tmp_path / "again.npz")
    robot, command, speeds = MujocoRobot(spec, 0.02, 0), np.array([0.5, 0.0, 0.3]), []
    with loop(policy, tmp_path, robot.names) as step:
        for k in range(500):
            robot.command(step(k * spec["control_dt"], command=command, **robot.measure()))
            heading = np.zeros(9)
            robot.mujoco.mju_quat2Mat(heading, robot.state.qpos[3:7])
            speeds.append([*(heading.reshape(3, 3).T @ robot.state.qvel[:3])[:2], robot.state.qvel[5]])
            assert robot.state.qpos[2] > 0.6 * spec["standing_height"], f"fell after {k} steps"
    np.testing.assert_allclose(np.mean(speeds[100:], axis=0), command, atol=0.1)


def test_checks_of_the_numpy_loop(tmp_path):
    spec = export_policy(SHIPPED, tmp_path / "walk.npz")
    n, dt = len(spec["joints"]), spec["control_dt"]
    with pytest.raises(ValueError, match=r"the robot lacks the joints \['FL_knee_link_joint'\]"):
        PolicyLoop(tmp_path / "walk.npz", [name for name in spec["joints"] if name != "FL_knee_link_joint"])
    loop = PolicyLoop(tmp_path / "walk.npz", spec["joints"])
    still = {"quaternion": [1, 0, 0, 0], "gyro": np.zeros(3), "velocities": np.zeros(n), "command": np.zeros(3)}

    def counts(stamp: float, now: float, **measured: Any) -> dict[str, int]:
        before = dict(loop.counts)
        loop.step(stamp, now=now, **{**still, "positions": spec["default_pose"], **measured})
        return {key: int(count - before[key]) for key, count in loop.counts.items() if count != before[key]}

    assert counts(0.0, 0.0) == {}
    assert counts(dt, dt + 1.5 * dt) == {"late": 1}
    assert counts(2.5 * dt, 2.5 * dt).get("rate") == 1
    assert counts(3.5 * dt, 3.5 * dt, velocities=np.full(n, 1e4)).get("saturated") == 1
    loop.layers[-1] = tuple(1000 * array for array in loop.layers[-1])
    assert counts(4.5 * dt, 4.5 * dt).get("clipped") == 1


def test_policies_that_need_the_speed_of_the_base_are_refused(tmp_path):
    spec = export_policy("mini_cheetah_velocity", tmp_path / "walk.npz")
    loop = PolicyLoop(tmp_path / "walk.npz", spec["joints"])
    with pytest.raises(ValueError, match="not measured; expected a deployable policy"):
        loop.step(0.0, [1, 0, 0, 0], np.zeros(3), np.zeros(12), np.zeros(12), np.zeros(3))
