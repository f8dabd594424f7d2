"""Evaluate a policy in MuJoCo without changes: does it walk on physics that differs from its training?

The robot is exported as MJCF at two levels: with armature, and with each rotor as a body with a stiff equality. MuJoCo
and ce_gym use the same initial states, gains, limits and random commands. The observation terms of the task compute
observations from MuJoCo's state. A policy passes if nearly all robots stay on their feet in MuJoCo and its errors are
not much larger than at the same level of ce_gym. Needs MuJoCo (extra `mjcf`).

    python train/sim2sim.py runs/mini_cheetah_velocity
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.learn.evaluate.episodes import COLUMNS, UNDISTURBED, planar_velocity, tracking, weights_seed
from ce_gym.learn.evaluate.evaluation import env_kwargs
from ce_gym.model import RobotError
from ce_gym.policies import Policy, PolicyError

STEADY = {**UNDISTURBED, "randomise": {}, "latency": (0, 0)}
"""Arguments of an environment without features that MuJoCo lacks; this file sets the commands."""

STANDING_FRACTION = 0.1
"""Fraction of commands to stand."""

ON_FEET, WORSE = 0.95, 1.5
"""Requirements in MuJoCo: smallest fraction without a fall; largest ratio of errors, MuJoCo to ce_gym."""

TWINS = {"armature": ("MuJoCo, armature", "armature"), "exact": ("MuJoCo, rotors as bodies", "exact")}
"""For each level of `MujocoTwin`: its name, and the level of ce_gym with the same physics."""


class World(Protocol):
    """A simulation in which a policy acts."""

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Make one control step.

        Args:
            action: Actions, shape (n, n_actions).
            command: Commands of the next observation, shape (n, 3).

        Returns:
            The next observations; velocities v (n, nv); whether each robot has fallen (n,).
        """
        ...


class OurWorld:
    """The environment, simulated by ce_gym."""

    def __init__(self, envs: SB3VecEnv) -> None:
        self.envs = envs
        self.native: Any = envs.envs.unwrapped

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Step the environment; see `World`. A robot that has fallen starts another episode."""
        self.native.set_command(command)
        obs, _, dones, _ = self.envs.step(action)
        return obs, self.native.state()["v"], dones


class MujocoWorld:
    """The same robots in MuJoCo, with observations by the terms of the environment.

    Args:
        native: The environment after its reset.
        obs: First observations of the environment.
        level: A level of `MujocoTwin`.

    Raises:
        PolicyError: If actions are not joint targets.
    """

    def __init__(self, native: Any, obs: Any, level: str) -> None:
        from ce_gym.export.mujoco_twin import MujocoTwin

        self.native, self.policy_spec = native, native.policy_spec()
        action = self.policy_spec["action"]
        if action["kind"] != "joint_pd":
            raise PolicyError(f"actions={action['kind']!r}; expected 'joint_pd': the MuJoCo model has position control")
        joints = self.policy_spec["joints"]
        self.columns = [joints.index(name) for name in action["joints"]]
        self.scale = np.array(action["scale"])
        state = native.state()
        self.twin = MujocoTwin(native.model.robot, level, len(state["q"]))
        self.twin.start(state["q"], state["v"])
        self.obs = np.array(obs["policy"] if isinstance(obs, dict) else obs)
        self.clock = 0

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Step MuJoCo and compute observations; see `World`."""
        action = np.clip(action, -1.0, 1.0)
        target = np.tile(self.policy_spec["default_pose"], (len(action), 1))
        target[:, self.columns] += self.scale * action
        self.twin.step(target, self.policy_spec["control_dt"])
        self.clock += 1
        q, v = self.twin.state()
        clock = np.full((len(q), 1), self.clock)
        frame, failed = self.native.look({"q": q, "v": v, "action": action, "command": command, "clock": clock})
        kept = self.obs.shape[1] - frame.shape[1]  # size of the history that stays; the newest frame is first
        self.obs = np.hstack([frame, self.obs[:, :kept]])
        return self.obs, v, failed | self.twin.diverged


@dataclass(frozen=True)
class Course:
    """Commands of an evaluation.

    Attributes:
        commands: Forward, lateral [m/s], yaw rate [rad/s] at each control step, shape (n_steps + 1, n, 3).
        control_dt: Length of a control step [s].
    """

    commands: NDArray
    control_dt: float


def random_course(policy_spec: dict[str, Any], first: NDArray, seconds: float, every: float, seed: int) -> Course:
    """Return random commands from the task's range that change `every` [s], after the given first commands (n, 3)."""
    dt, rng = policy_spec["control_dt"], np.random.default_rng(seed)
    steps = round(seconds / dt)
    period = min(max(round(min(every, seconds + dt) / dt), 1), steps + 1)
    low, high = np.array(policy_spec["command"]["range"]).T
    commands = [first]
    for _ in range(steps // period):
        standing = rng.random((len(first), 1)) < STANDING_FRACTION
        commands.append(np.where(standing, 0.0, rng.uniform(low, high, first.shape)))
    return Course(np.repeat(commands, period, axis=0)[: steps + 1], dt)


def play(policy: Policy, world: World, obs: Any, course: Course) -> dict[str, float]:
    """Let a policy act until the commands end, and evaluate each robot until its first fall.

    Returns:
        Errors, see `episodes.tracking`. falls: fraction of robots. episode_length [s]: mean.
    """
    running = np.ones(course.commands.shape[1], bool)
    errors, steps = [np.zeros((0, 3))], 0
    for command, following in zip(course.commands[:-1], course.commands[1:], strict=True):
        action, _ = policy.predict(obs)
        obs, v, failed = world.step(action, following)
        running &= ~failed
        errors.append((planar_velocity(v) - command)[running])
        steps += int(running.sum())
        if not running.any():
            break
    return {
        **tracking(np.concatenate(errors)),
        "falls": float(np.mean(~running)),
        "episode_length": steps * course.control_dt / len(running),
    }


def compare(
    policy: Policy,
    *,
    episodes: int = 50,
    seconds: float = 10.0,
    every: float = float("inf"),
    seed: int | None = None,
) -> dict[str, Any]:
    """Evaluate a policy with the same commands in ce_gym, at its training level and two more, and in MuJoCo.

    Args:
        policy: Policy with its record.
        episodes: Number of robots.
        seconds: Duration [s].
        every: Time between new commands [s].
        seed: Seed of initial states and commands; None computes the seed from the weights.

    Returns:
        simulations: result of `play` by name of the simulation. verdict: see `verdicts`. passed: whether all passed.

    Raises:
        ModuleNotFoundError: If MuJoCo is not installed.
    """
    import ce_gym.export.mujoco_twin  # noqa: F401  # fails at the start if MuJoCo is missing

    record, results = policy.record, {}
    seed = weights_seed(policy) if seed is None else seed
    for level in dict.fromkeys((record["transmission"], "exact", "armature")):
        envs, obs, course = _environment(record, level, episodes, seconds, every, seed)
        results[_ours(level)] = play(policy, OurWorld(envs), obs, course)
        envs.close()
    for level, (name, _) in TWINS.items():
        envs, obs, course = _environment(record, record["transmission"], episodes, seconds, every, seed)
        native: Any = envs.envs.unwrapped
        try:
            if level == "exact" and (reason := _without_ratios(native.model.robot)):
                print(f"{name}: not evaluated: {reason}", file=sys.stderr)
                continue
            results[name] = play(policy, MujocoWorld(native, obs, level), obs, course)
        except RobotError as error:  # MJCF has no armature that varies with the pose, as loops need
            if level == "exact":
                raise
            print(f"{name}: not evaluated: {error}", file=sys.stderr)
        finally:
            envs.close()
    verdict = verdicts(results)
    if not verdict:
        raise RobotError("MuJoCo has neither level of this robot: nothing was compared")
    return {"simulations": results, "verdict": verdict, "passed": all(each["passed"] for each in verdict.values())}


def _without_ratios(robot: Any) -> str:
    """Return why rotors cannot be bodies in MuJoCo (unknown ratios give rotors no inertia), or an empty string."""
    rotors = robot.unknown_ratios
    if not rotors:
        return ""
    names = ", ".join(rotors[:3]) + (f" and {len(rotors) - 3} more" if len(rotors) > 3 else "")
    return f"the file of {robot.name} gives no gear ratio for {names}; `gears:` in a YAML file gives it"


def _ours(level: str) -> str:
    return f"ce_gym, {level}"


def verdicts(results: dict[str, dict[str, float]]) -> dict[str, dict[str, Any]]:
    """Compare MuJoCo's levels with the same levels of ce_gym.

    Returns:
        For each simulation in MuJoCo: on_feet, fraction without a fall; error_ratio and yaw_ratio, velocity and yaw
        rate error divided by the error in ce_gym; passed, whether these satisfy `ON_FEET` and `WORSE`.
    """
    result = {}
    for name, level in TWINS.values():
        if name not in results:
            continue
        theirs, ours = results[name], results[_ours(level)]
        on_feet = 1.0 - theirs["falls"]
        ratios = [theirs[key] / max(ours[key], 1e-9) for key in ("velocity_error", "yaw_rate_error")]
        passed = on_feet >= ON_FEET and all(ratio <= WORSE for ratio in ratios)  # False for NaN
        result[name] = {"on_feet": on_feet, "error_ratio": ratios[0], "yaw_ratio": ratios[1], "passed": passed}
    return result


def _environment(
    record: dict[str, Any], level: str, n: int, seconds: float, every: float, seed: int
) -> tuple[SB3VecEnv, Any, Course]:
    """Return an environment after its reset, observations, and commands; commands are the same at all levels."""
    clear = {block["name"]: 0.0 for block in record["policy_spec"]["observation"]["blocks"]}
    kwargs = {**env_kwargs(record, level), **STEADY, "noise": clear, "max_episode_steps": 10**9}
    envs = make_sb3_vec_env(record["env"], n, seed, **kwargs)
    obs = envs.reset()
    native: Any = envs.envs.unwrapped
    return envs, obs, random_course(native.policy_spec(), native.state()["command"], seconds, every, seed)


def table(result: dict[str, Any]) -> str:
    """Return one line per simulation, then one per verdict."""
    lines = [f"{'simulated by':<26}" + "".join(f"{title:>15}" for title, _, _ in COLUMNS)]
    for name, figures in result["simulations"].items():
        lines.append(f"{name:<26}" + "".join(f"{figures[key]:>15{form}}" for _, key, form in COLUMNS))
    lines += ["errors are means over every step until a robot falls", ""]
    for name, verdict in result["verdict"].items():
        errors = f"velocity error {verdict['error_ratio']:.2f} and yaw rate error {verdict['yaw_ratio']:.2f} times ours"
        outcome = "passed" if verdict["passed"] else "FAILED"
        lines.append(f"{name:<26} {verdict['on_feet']:.0%} without a fall, {errors}: {outcome}")
    return "\n".join([*lines, f"required: at least {ON_FEET:.0%} without a fall, errors at most {WORSE:g} times ours"])
