"""Evaluate a policy in MuJoCo without changes: does it walk on physics that differs from its training?

The robot is exported as MJCF at two levels: with armature, and with each rotor as a body with a stiff equality. MuJoCo
and ce_gym use the same initial states, gains, limits and random commands. The observation terms of the task compute
observations from MuJoCo's state. A policy passes if nearly all robots stay on their feet in MuJoCo and its errors are
not much larger than at the same level of ce_gym. Needs MuJoCo (extra `mjcf`).
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.evaluation.episodes import (
    UNDISTURBED,
    UNLIMITED,
    TrackingErrors,
    command_ranges,
    open_environments,
    run_policy,
    weights_seed,
)
from ce_gym.learn.evaluation.tables import table
from ce_gym.model import RobotError
from ce_gym.policies import Policy, PolicyError

STEADY = {**UNDISTURBED, "randomise": {}, "latency": (0, 0), "max_episode_steps": UNLIMITED}
"""Arguments of an environment without features that MuJoCo lacks; this file sets the commands."""

STANDING_FRACTION = 0.1
"""Fraction of commands to stand."""

ON_FEET, WORSE = 0.95, 1.5
"""Requirements in MuJoCo: smallest fraction without a fall; largest ratio of errors, MuJoCo to ce_gym."""

TWINS = {"armature": "MuJoCo, armature", "exact": "MuJoCo, rotors as bodies"}
"""Name of the simulation for each level of `MujocoTwin`."""


class MujocoEnvs(VectorEnv):
    """The robots of environments in MuJoCo, with observations by the terms of the environments.

    Args:
        native: The environments after their reset.
        obs: First observations of the environments.
        level: A level of `MujocoTwin`.

    Raises:
        PolicyError: If actions are not joint targets.
        RobotError: If MuJoCo cannot express the robot at that level.
    """

    def __init__(self, native: Any, obs: Any, level: str) -> None:
        from ce_gym.export.mujoco_twin import MujocoTwin

        self.native, self.policy_spec = native, native.policy_spec()
        action = self.policy_spec["action"]
        if action["kind"] != "joint_pd":
            raise PolicyError(f"actions={action['kind']!r}; expected 'joint_pd': the MuJoCo model has position control")
        if level == "exact":
            _check_ratios(native.model.robot)
        joints = self.policy_spec["joints"]
        self.columns = [joints.index(name) for name in action["joints"]]
        self.scale = np.array(action["scale"])
        state = native.state()
        self.num_envs, self.command = len(state["q"]), state["command"]
        self.twin = MujocoTwin(native.model.robot, level, self.num_envs)
        self.twin.start(state["q"], state["v"])
        self.obs = np.array(obs["policy"] if isinstance(obs, dict) else obs)
        self.clock = 0

    def step(self, actions: NDArray) -> tuple[Any, NDArray, NDArray, NDArray, dict[str, Any]]:
        """Make a control step; observations have the command that was set last."""
        action = np.clip(actions, -1.0, 1.0)
        target = np.tile(self.policy_spec["default_pose"], (len(action), 1))
        target[:, self.columns] += self.scale * action
        self.twin.step(target, self.policy_spec["control_dt"])
        self.clock += 1
        clock = np.full((self.num_envs, 1), self.clock)
        frame, failed = self.native.look({**self.state(), "action": action, "clock": clock})
        kept = self.obs.shape[1] - frame.shape[1]  # size of the history that stays; the newest frame is first
        self.obs = np.hstack([frame, self.obs[:, :kept]])
        return self.obs, np.zeros(self.num_envs), failed, self.twin.diverged, {}

    def state(self) -> dict[str, NDArray]:
        """Return `q` (n, nq), `v` (n, nv) and `command` (n, 3)."""
        q, v = self.twin.state()
        return {"q": q, "v": v, "command": self.command}

    def set_command(self, command: NDArray) -> None:
        """Set the commanded velocities, shape (n, 3)."""
        self.command = command


def random_commands(policy_spec: dict[str, Any], first: NDArray, seconds: float, every: float, seed: int) -> NDArray:
    """Return commands for `seconds` [s], shape (n_steps + 1, n, 3), after `first` (n, 3).

    New commands are random in the task's range, and change `every` [s].
    """
    dt, rng = policy_spec["control_dt"], np.random.default_rng(seed)
    steps = round(seconds / dt)
    period = min(max(round(min(every, seconds + dt) / dt), 1), steps + 1)
    low, high = np.array(policy_spec["command"]["range"]).T
    commands = [first]
    for _ in range(steps // period):
        standing = rng.random((len(first), 1)) < STANDING_FRACTION
        commands.append(np.where(standing, 0.0, rng.uniform(low, high, first.shape)))
    return np.repeat(commands, period, axis=0)[: steps + 1]


def play(
    policy: Policy, envs: VectorEnv, obs: Any, commands: NDArray, control_dt: float, label: str = ""
) -> dict[str, float]:
    """Let a policy act until its commands (n_steps + 1, n, 3) end, and evaluate each robot until its first fall.

    The commands are those at each control step of length `control_dt` [s]. For other arguments, see `run_policy`.

    Returns:
        Errors, see `evaluation.evaluate`. falls: fraction of robots. episode_length [s]: mean.
    """
    native: Any = envs.unwrapped
    steps, n, _ = commands.shape
    errors, running = TrackingErrors(n), np.ones(n, bool)

    def set_next_command(number: int) -> None:
        native.set_command(commands[number + 1])

    for number, step in enumerate(run_policy(policy, envs, obs, set_next_command, steps - 1, label)):
        running &= ~step.done
        errors.add(native.state()["v"], commands[number], running)
        if not running.any():
            break
    length = float(errors.counts.sum()) * control_dt / n
    return {**errors.means(), "falls": float(np.mean(~running)), "episode_length": length}


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
        PolicyError: If the task of the policy has no commands.
    """
    import ce_gym.export.mujoco_twin  # noqa: F401  # fails at the start if MuJoCo is missing

    record, results, missing = policy.record, {}, []
    command_ranges(policy, "sim2sim")
    spec, trained = record["policy_spec"], record["transmission"]
    arguments = STEADY | {"noise": {block["name"]: 0.0 for block in spec["observation"]["blocks"]}}
    seed = weights_seed(policy) if seed is None else seed
    ours = {_ours(level): (level, "") for level in (trained, "exact", "armature")}
    for name, (level, twin) in (ours | {name: (trained, level) for level, name in TWINS.items()}).items():
        kwargs = {**record["env_kwargs"], "transmission": level, **arguments}
        with open_environments(record["env"], episodes, seed, **kwargs) as (envs, obs):
            native: Any = envs.unwrapped
            spec = native.policy_spec()
            commands = random_commands(spec, native.state()["command"], seconds, every, seed)
            try:
                world = MujocoEnvs(native, obs, twin) if twin else envs
            except RobotError as error:
                missing.append(f"{name}: not evaluated: {error}")
                print(missing[-1], file=sys.stderr)
                continue
            results[name] = play(policy, world, obs, commands, spec["control_dt"], name)
    verdict = verdicts(results)
    if not verdict:
        raise RobotError("; ".join(missing))
    return {"simulations": results, "verdict": verdict, "passed": all(each["passed"] for each in verdict.values())}


def _check_ratios(robot: Any) -> None:
    """Refuse a robot whose rotors cannot be bodies in MuJoCo, because unknown ratios give rotors no inertia.

    Raises:
        RobotError: If a gear ratio is unknown.
    """
    if rotors := robot.unknown_ratios:
        names = ", ".join(rotors[:3]) + (f" and {len(rotors) - 3} more" if len(rotors) > 3 else "")
        reason = f"the file of {robot.name} gives no gear ratio for {names}"
        raise RobotError(f"{reason}; `gears:` in a YAML file gives it")


def _ours(level: str) -> str:
    return f"ce_gym, {level}"


def verdicts(results: dict[str, dict[str, float]]) -> dict[str, dict[str, Any]]:
    """Compare MuJoCo's levels with the same levels of ce_gym.

    Returns:
        For each simulation in MuJoCo: on_feet, fraction without a fall; error_ratio and yaw_ratio, velocity and yaw
        rate error divided by the error in ce_gym; passed, whether these satisfy `ON_FEET` and `WORSE`.
    """
    result = {}
    for level, name in TWINS.items():
        if name not in results:
            continue
        theirs, ours = results[name], results[_ours(level)]
        on_feet = 1.0 - theirs["falls"]
        ratios = [theirs[key] / max(ours[key], 1e-9) for key in ("velocity_error", "yaw_rate_error")]
        passed = on_feet >= ON_FEET and all(ratio <= WORSE for ratio in ratios)  # False for NaN
        result[name] = {"on_feet": on_feet, "error_ratio": ratios[0], "yaw_ratio": ratios[1], "passed": passed}
    return result


def comparison_table(result: dict[str, Any]) -> str:
    """Return a Markdown table with one line per simulation, and the requirements."""
    rows = {name: {**figures, "verdict": ""} for name, figures in result["simulations"].items()}
    for name, verdict in result["verdict"].items():
        ratios = f"{verdict['error_ratio']:.2f} and {verdict['yaw_ratio']:.2f} times the errors"
        rows[name]["verdict"] = f"{'passed' if verdict['passed'] else 'FAILED'}: {ratios}"
    keys = ("forward_error", "lateral_error", "yaw_rate_error", "velocity_error", "falls", "episode_length", "verdict")
    bars = f"at least {ON_FEET:.0%} without a fall, and at most {WORSE:g} times the errors"
    note = f"Required in MuJoCo: {bars} of ce_gym at the same level, in velocity and yaw rate."
    return f"{table('simulated by', rows, *keys)}\n\n{note}"
