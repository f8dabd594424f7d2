"""Evaluate a policy in MuJoCo, unchanged: does it walk on physics that it was not trained on?

The robot is exported as MJCF at two levels, with armature and with every rotor a body on a stiff equality; it starts
in the same states, has the same gains and limits, and gets the same random commands as in our own simulation beside it.
Observations are rebuilt from MuJoCo's state by the task's own terms. The verdict: on each level nearly all keep on
their feet, and commands are followed hardly worse than on the same level of ours. Needs MuJoCo (extra `mjcf`). Uses
public names of ce_gym only, and no name of a robot or task.

    python train/sim2sim.py runs/mini_cheetah_velocity
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import argparse
import sys
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from console import EPISODES, Parser, above_zero, add_json_argument, print_result, run
from episodes import planar_velocity, tracking
from evaluate import WEIGHTS_SEED, env_kwargs, load
from numpy.typing import NDArray
from suites import weights_seed

from ce_gym import RobotError
from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.policies import WHERE, Policy, PolicyError, add_env_arguments

STEADY = {"push_period": 0.0, "randomise": {}, "latency": (0, 0), "heading": False, "command_period": 1e6}
"""What is left out of the comparison, as MuJoCo knows nothing of it; commands come from here."""

STANDING_FRACTION = 0.1
"""Share of commands that ask the robot to stand."""

ON_FEET, WORSE = 0.95, 1.5
"""What is asked for in MuJoCo: share without a fall, at least; errors over those of our own simulation, at most."""

TWINS = {"armature": ("MuJoCo, armature", "armature"), "exact": ("MuJoCo, rotors as bodies", "exact")}
"""Name of each level of `MujocoTwin`, and the level of ours that has the same physics."""

COLUMNS = (
    ("forward [m/s]", "forward_error", ".3f"),
    ("lateral [m/s]", "lateral_error", ".3f"),
    ("velocity [m/s]", "velocity_error", ".3f"),
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
        from ce_gym.export.mujoco_twin import MujocoTwin

        self.native, self.policy_spec = native, native.policy_spec()
        action = self.policy_spec["action"]
        if action["kind"] != "joint_pd":
            raise PolicyError(f"actions={action['kind']!r}; expected 'joint_pd': MuJoCo has position control here")
        joints = self.policy_spec["joints"]
        self.moved, self.scale = [joints.index(name) for name in action["joints"]], np.array(action["scale"])
        state = native.state()
        self.twin = MujocoTwin(native.model.robot, level, len(state["q"]))
        self.twin.start(state["q"], state["v"])
        self.seen = np.array(obs["policy"] if isinstance(obs, dict) else obs)
        self.clock = 0

    def step(self, action: NDArray, command: NDArray) -> tuple[Any, NDArray, NDArray]:
        """Step MuJoCo and look; see `World`."""
        action = np.clip(action, -1.0, 1.0)
        target = np.tile(self.policy_spec["default_pose"], (len(action), 1))
        target[:, self.moved] += self.scale * action
        self.twin.step(target, self.policy_spec["control_dt"])
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


def course(policy_spec: dict[str, Any], first: NDArray, seconds: float, every: float, seed: int) -> Course:
    """Draw commands from the task's range, new ones `every` so many seconds; the first are given, shape (n, 3)."""
    dt, rng = policy_spec["control_dt"], np.random.default_rng(seed)
    steps = round(seconds / dt)
    period = min(max(round(min(every, seconds + dt) / dt), 1), steps + 1)
    low, high = np.array(policy_spec["command"]["range"]).T
    drawn = [first]
    for _ in range(steps // period):
        standing = rng.random((len(first), 1)) < STANDING_FRACTION
        drawn.append(np.where(standing, 0.0, rng.uniform(low, high, first.shape)))
    return Course(np.repeat(drawn, period, axis=0)[: steps + 1], dt)


def play(policy: Policy, world: World, obs: Any, given: Course) -> dict[str, float]:
    """Act until the course ends, and judge every robot up to its first fall.

    Returns:
        Errors as of `evaluate.tracking`. falls: fraction of robots. episode_length [s]: mean.
    """
    running = np.ones(given.commands.shape[1], bool)
    errors, steps = [np.zeros((0, 3))], 0
    for command, following in zip(given.commands[:-1], given.commands[1:], strict=True):
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
        "episode_length": steps * given.control_dt / len(running),
    }


def compare(
    policy: Policy,
    *,
    episodes: int = 50,
    seconds: float = 10.0,
    every: float = float("inf"),
    seed: int | None = None,
) -> dict[str, Any]:
    """Play the same course with our dynamics, at the level of training and the two of MuJoCo, and with MuJoCo's.

    Args:
        policy: With its record.
        episodes: Robots.
        seconds: How long they walk.
        every: Time between new commands [s]; one for the whole time if longer than that.
        seed: Of starts and commands; None takes the one that the policy's weights give.

    Returns:
        simulations: the result of `play` by the name of the simulation; verdict: see `verdicts`; passed: whether all
        of them are.

    Raises:
        ModuleNotFoundError: MuJoCo is not installed.
    """
    import ce_gym.export.mujoco_twin  # noqa: F401  # fails before our own simulation if MuJoCo is missing

    record, results = policy.record, {}
    seed = weights_seed(policy) if seed is None else seed
    for level in dict.fromkeys((record["transmission"], "exact", "armature")):
        envs, obs, given = _environment(record, level, episodes, seconds, every, seed)
        results[_ours(level)] = play(policy, OurWorld(envs), obs, given)
        envs.close()
    for level, (name, _) in TWINS.items():
        envs, obs, given = _environment(record, record["transmission"], episodes, seconds, every, seed)
        native: Any = envs.envs.unwrapped
        try:
            if level == "exact" and (reason := _without_ratios(native.model.robot)):
                print(f"{name}: not judged: {reason}", file=sys.stderr)
                continue
            results[name] = play(policy, MujocoWorld(native, obs, level), obs, given)
        except RobotError as error:  # of loops MJCF can say `exact`, but no armature that varies with the pose
            if level == "exact":
                raise
            print(f"{name}: not judged: {error}", file=sys.stderr)
        finally:
            envs.close()
    found = verdicts(results)
    if not found:
        raise RobotError("MuJoCo has neither level of this robot: nothing was compared")
    return {"simulations": results, "verdict": found, "passed": all(verdict["passed"] for verdict in found.values())}


def _without_ratios(robot: Any) -> str:
    """Return why rotors cannot be bodies in MuJoCo: placeholder ratios leave them no inertia. Empty if they can."""
    rotors = robot.unknown_ratios
    if not rotors:
        return ""
    names = ", ".join(rotors[:3]) + (f" and {len(rotors) - 3} more" if len(rotors) > 3 else "")
    return f"the file of {robot.name} gives no gear ratio for {names}; `gears:` in a YAML file gives it"


def _ours(level: str) -> str:
    return f"ce_gym, {level}"


def verdicts(results: dict[str, dict[str, float]]) -> dict[str, dict[str, Any]]:
    """Judge MuJoCo's levels against the same levels of ours.

    Returns:
        By the name of the simulation: on_feet, share without a fall; error_ratio and yaw_ratio, velocity and yaw rate
        error over ours; passed, whether these are within `ON_FEET` and `WORSE`. A level that MJCF cannot say is left
        out.
    """
    found = {}
    for name, level in TWINS.values():
        if name not in results:
            continue
        theirs, ours = results[name], results[_ours(level)]
        on_feet = 1.0 - theirs["falls"]
        ratios = [theirs[key] / max(ours[key], 1e-9) for key in ("velocity_error", "yaw_rate_error")]
        passed = on_feet >= ON_FEET and all(ratio <= WORSE for ratio in ratios)  # not if nothing was measured
        found[name] = {"on_feet": on_feet, "error_ratio": ratios[0], "yaw_ratio": ratios[1], "passed": passed}
    return found


def _environment(
    record: dict[str, Any], level: str, n: int, seconds: float, every: float, seed: int
) -> tuple[SB3VecEnv, Any, Course]:
    """An environment just reset, its observations, and what is commanded; the same for every level."""
    clear = {block["name"]: 0.0 for block in record["policy_spec"]["observation"]["blocks"]}
    kwargs = {**env_kwargs(record, level), **STEADY, "noise": clear, "max_episode_steps": 10**9}
    envs = make_sb3_vec_env(record["env"], n, seed, **kwargs)
    obs = envs.reset()
    native: Any = envs.envs.unwrapped
    return envs, obs, course(native.policy_spec(), native.state()["command"], seconds, every, seed)


def table(result: dict[str, Any]) -> str:
    """One line per simulation, then one per verdict."""
    lines = [f"{'simulated by':<26}" + "".join(f"{title:>15}" for title, _, _ in COLUMNS)]
    for name, figures in result["simulations"].items():
        lines.append(f"{name:<26}" + "".join(f"{figures[key]:>15{form}}" for _, key, form in COLUMNS))
    lines += ["errors are means over every step until a robot falls", ""]
    for name, verdict in result["verdict"].items():
        found = (
            f"{verdict['on_feet']:.0%} without a fall, velocity error {verdict['error_ratio']:.2f} and yaw rate error"
        )
        found += f" {verdict['yaw_ratio']:.2f} times ours: {'passed' if verdict['passed'] else 'FAILED'}"
        lines.append(f"{name:<26} {found}")
    return "\n".join([*lines, f"asked for: at least {ON_FEET:.0%} without a fall, errors at most {WORSE:g} times ours"])


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(
        description="Let a policy act in MuJoCo, beside our own simulation. Exit code 0 if it does well enough in "
        "both of MuJoCo's, 1 if not, 2 after a mistake.",
    )
    parser.add_argument("policy", help=WHERE)
    parser.add_argument("--episodes", type=EPISODES, default=50, metavar="N", help="robots (default 50)")
    parser.add_argument("--seconds", type=above_zero, default=10.0, metavar="T", help="how long they walk (default 10)")
    text = "new commands every T seconds (default: one for the whole time)"
    parser.add_argument("--every", type=above_zero, default=float("inf"), metavar="T", help=text)
    text = "of starts and commands (default: the first 32 bits of the SHA-256 of the policy's weights)"
    parser.add_argument("--seed", type=WEIGHTS_SEED, metavar="N", help=text)
    add_env_arguments(parser)
    add_json_argument(parser)
    args = parser.parse_args(argv)
    return run("sim2sim.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Compare, print, and say whether it passed."""
    policy = load(args.policy, args.env, env_args=args.env_args)
    result = compare(policy, episodes=args.episodes, seconds=args.seconds, every=args.every, seed=args.seed)
    print_result(result, table(result), args.json)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
