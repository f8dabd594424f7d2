"""Let a policy act in MuJoCo as it is: does it walk on physics that it was not trained on?

The robot is exported as MJCF at two levels, with armature and with every rotor a body on a stiff equality; it starts
in the same states, has the same gains and limits, and gets the same random commands as in our own simulation beside it.
Observations are rebuilt from MuJoCo's state by the task's own terms. Needs MuJoCo (extra `mjcf`). Uses public names of
ce_gym only, and no name of a robot or task.

    python train/sim2sim.py runs/mini_cheetah_velocity/policy.zip
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from evaluate import EVALUATION_SEED, env_kwargs
from numpy.typing import NDArray
from policy_file import Policy, PolicyError, read_policy

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.bench.mujoco_twin import TIMESTEPS, MujocoTwin

STEADY = {"push_period": 0.0, "randomise": {}, "latency": (0, 0), "heading": False, "command_period": 1e6}
"""What is left out of the comparison, as MuJoCo knows nothing of it; commands come from here."""

STANDING_FRACTION = 0.1
"""Share of commands that ask the robot to stand."""

COLUMNS = (
    ("forward [m/s]", "forward_error", ".3f"),
    ("lateral [m/s]", "lateral_error", ".3f"),
    ("yaw [rad/s]", "yaw_rate_error", ".3f"),
    ("falls", "falls", ".1%"),
    ("length [s]", "episode_length", ".1f"),
)


class World(Protocol):
    """Robots that a policy can act on."""

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Carry out one control step.

        Args:
            action: Shape (n, n_actions).
            command: What the next observation shall show, shape (n, 3).

        Returns:
            The next observations; base velocity v (n, nv); whether each robot has fallen (n,).
        """
        ...


class OurWorld:
    """The environment itself."""

    def __init__(self, envs: SB3VecEnv) -> None:
        self.envs = envs
        self.native: Any = envs.envs.unwrapped

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Step the environment; see `World`. A robot that has fallen shows another episode."""
        self.native.set_command(command)
        obs, _, dones, _ = self.envs.step(action)
        return obs, self.native.state()["v"], dones


class MujocoWorld:
    """The same robots in MuJoCo, observed by the environment's terms.

    Args:
        native: The environment, just reset.
        obs: Its first observations.
        level: A level of `MujocoTwin`.

    Raises:
        PolicyError: If actions are no joint targets.
    """

    def __init__(self, native: Any, obs: Any, level: str) -> None:
        self.native, self.contract = native, native.contract()
        action = self.contract["action"]
        if action["kind"] != "joint_pd":
            raise PolicyError(f"actions={action['kind']!r}; expected 'joint_pd': MuJoCo has position control here")
        joints = self.contract["joints"]
        self.moved, self.scale = [joints.index(name) for name in action["joints"]], np.array(action["scale"])
        state = native.state()
        self.twin = MujocoTwin(native.model.robot, level, len(state["q"]))
        self.twin.start(state["q"], state["v"])
        self.seen = np.array(obs["policy"] if isinstance(obs, dict) else obs)
        self.clock = 0

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Step MuJoCo and look; see `World`."""
        action = np.clip(action, -1.0, 1.0)
        target = np.tile(self.contract["default_pose"], (len(action), 1))
        target[:, self.moved] += self.scale * action
        self.twin.step(target, self.contract["control_dt"])
        self.clock += 1
        q, v = self.twin.state()
        clock = np.full((len(q), 1), self.clock)
        frame, failed = self.native.look({"q": q, "v": v, "action": action, "command": command, "clock": clock})
        kept = self.seen.shape[1] - frame.shape[1]  # of the history, newest first
        self.seen = np.hstack([frame, self.seen[:, :kept]])
        return self.seen, v, failed | self.twin.diverged


@dataclass(frozen=True)
class Course:
    """What robots are asked to do.

    Attributes:
        commands: Forward, lateral [m/s], yaw rate [rad/s] at every control step, shape (n_steps + 1, n, 3).
        control_dt: Length of a control step [s].
    """

    commands: NDArray
    control_dt: float


def course(contract: dict[str, Any], first: NDArray, seconds: float, seed: int) -> Course:
    """Draw commands from the task's range, new ones every period; the first are given, shape (n, 3)."""
    dt, rng = contract["control_dt"], np.random.default_rng(seed)
    steps = round(seconds / dt)
    period = min(max(round(contract["command"]["period"] / dt), 1), steps + 1)
    low, high = np.array(contract["command"]["range"]).T
    drawn = [first]
    for _ in range(steps // period):
        standing = rng.random((len(first), 1)) < STANDING_FRACTION
        drawn.append(np.where(standing, 0.0, rng.uniform(low, high, first.shape)))
    return Course(np.repeat(drawn, period, axis=0)[: steps + 1], dt)


def play(policy: Policy, world: World, obs: Any, given: Course) -> dict[str, float]:
    """Act until the course ends, and judge every robot up to its first fall.

    Returns:
        forward_error, lateral_error [m/s], yaw_rate_error [rad/s]: mean absolute difference between commanded and
        actual base velocity, in base coordinates. falls: fraction of robots. episode_length [s]: mean.
    """
    running = np.ones(given.commands.shape[1], bool)
    errors, steps = [], 0
    for command, following in zip(given.commands[:-1], given.commands[1:], strict=True):
        action, _ = policy.predict(obs)
        obs, v, failed = world.step(action, following)
        running &= ~failed
        errors.append(np.abs(v[:, [3, 4, 2]] - command)[running])
        steps += int(running.sum())
        if not running.any():
            break
    forward, lateral, yaw = np.concatenate(errors).mean(axis=0).tolist() if steps else (float("nan"),) * 3
    return {
        "forward_error": forward,
        "lateral_error": lateral,
        "yaw_rate_error": yaw,
        "falls": float(np.mean(~running)),
        "episode_length": steps * given.control_dt / len(running),
    }


def compare(policy: Policy, *, episodes: int = 64, seconds: float = 20.0, seed: int = EVALUATION_SEED) -> dict:
    """Play the same course with our dynamics, at the level of training and with armature, and with MuJoCo's.

    Returns:
        The result of `play` by the name of the simulation.
    """
    record, results = policy.record, {}
    for level in dict.fromkeys((record["transmission"], "armature")):
        envs, obs, given = _environment(record, level, episodes, seconds, seed)
        results[f"ce_gym, {level}"] = play(policy, OurWorld(envs), obs, given)
        envs.close()
    for level in TIMESTEPS:
        envs, obs, given = _environment(record, record["transmission"], episodes, seconds, seed)
        world = MujocoWorld(envs.envs.unwrapped, obs, level)
        name = "armature" if level == "armature" else "rotors as bodies"
        results[f"MuJoCo, {name}"] = play(policy, world, obs, given)
        envs.close()
    return results


def _environment(
    record: dict[str, Any], level: str, n: int, seconds: float, seed: int
) -> tuple[SB3VecEnv, Any, Course]:
    """An environment just reset, its observations, and what is commanded; the same for every level."""
    clear = {block["name"]: 0.0 for block in record["contract"]["observation"]["blocks"]}
    kwargs = {**env_kwargs(record, level), **STEADY, "noise": clear}
    envs = make_sb3_vec_env(record["env"], n, seed, max_episode_steps=10**9, **kwargs)
    obs = envs.reset()
    native: Any = envs.envs.unwrapped
    period = {"command": record["contract"]["command"]}  # the environment's own is out of force
    return envs, obs, course(native.contract() | period, native.state()["command"], seconds, seed)


def table(results: dict[str, dict[str, float]]) -> str:
    """One line per simulation."""
    lines = [f"{'simulated by':<26}" + "".join(f"{title:>15}" for title, _, _ in COLUMNS)]
    for name, result in results.items():
        lines.append(f"{name:<26}" + "".join(f"{result[key]:>15{form}}" for _, key, form in COLUMNS))
    return "\n".join([*lines, "errors are mean absolute, over every step until a robot falls"])


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Let a policy act in MuJoCo, beside our own simulation.")
    parser.add_argument("policy", help="policy.zip of train/ppo.py, its policy.json beside it, or .onnx of export.py")
    parser.add_argument("--episodes", type=int, default=64, metavar="N", help="robots (default 64)")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="T", help="how long they walk (default 20)")
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="of starts and commands")
    parser.add_argument("--json", action="store_true", help="print the result as JSON and nothing else")
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON file to write as well")
    args = parser.parse_args(argv)
    try:
        results = compare(read_policy(args.policy), episodes=args.episodes, seconds=args.seconds, seed=args.seed)
        text = json.dumps(results, indent=2)
        if args.out:
            args.out.write_text(text + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        print(f"sim2sim.py: {error}", file=sys.stderr)
        return 2
    print(text if args.json else table(results))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
