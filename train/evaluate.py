"""Judge a trained policy: how well it follows its commands, how often it falls, what it asks of the motors.

Every environment of a batch plays exactly one whole episode, so that short episodes do not count more often than
long ones. Uses public names of ce_gym only, and no name of a robot or task.

    python train/evaluate.py runs/mini_cheetah_velocity --transmission armature
    python train/evaluate.py policy.onnx --pushes --json result.json
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from console import EPISODES, SEED, Parser, add_json_argument, print_result, run
from effort import effort
from pushes import push_envelope, push_table

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env
from ce_gym.policies import WHERE, Policy, environment_of, load_policy

if TYPE_CHECKING:
    from stable_baselines3 import PPO

EVALUATION_SEED = 1_000_000
"""Far from training seeds, so that a policy is judged on commands and starts it has not met."""


def load(path: str | Path, env: str | None = None, transmission: str | None = None) -> Policy:
    """Read a policy to judge; its record then names the environment to judge it in.

    Args:
        path: See `ce_gym.load_policy`.
        env: What the user's command line names; the environment of the record if None.
        transmission: Level that it will run on.

    Raises:
        PolicyError: If it cannot be used, or its environment is one that the user must name: see
            `ce_gym.policies.environment_of`.
    """
    policy = load_policy(path, transmission)
    return replace(policy, record=policy.record | {"env": environment_of(policy.record, env)})


def env_kwargs(record: dict[str, Any], transmission: str | None = None) -> dict[str, Any]:
    """Environment arguments a policy was trained with, on another transmission level if one is named."""
    kwargs = dict(record["env_kwargs"])
    return kwargs | {"transmission": transmission} if transmission else kwargs


def evaluate(
    model: PPO | Policy, env_id: str, *, episodes: int = 256, seed: int = EVALUATION_SEED, **kwargs: Any
) -> dict[str, float]:
    """Play one episode in each of `episodes` environments with the policy's mean action.

    Args:
        model: The policy.
        env_id: Registered environment id.
        episodes: Number of episodes, played side by side.
        seed: Of the first environment.
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        forward_error, lateral_error [m/s], yaw_rate_error [rad/s]: mean absolute difference between commanded and
        actual base velocity, in base coordinates, over every step of every episode; velocity_error [m/s]: the same of
        the length of the horizontal difference. falls, timed_out, diverged: fraction of episodes that ended early,
        that lasted to the end, and that were stopped because the state was no longer finite. episode_length [s],
        reward: means over episodes. episodes: their number. Other entries are means of what the task reports itself.
    """
    envs = make_sb3_vec_env(env_id, episodes, seed, **kwargs)
    try:
        return _play(model, envs)
    finally:
        envs.close()


def _play(model: PPO | Policy, envs: SB3VecEnv) -> dict[str, float]:
    """Step until every environment has ended its first episode."""
    native: Any = envs.envs.unwrapped
    period = 1.0 / native.metadata["render_fps"]
    errors, ended = [], {}
    obs = envs.reset()
    running = np.ones(envs.num_envs, bool)
    while running.any():
        command = native.state()["command"]  # the one the observation shows
        action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
        obs, _, dones, infos = envs.step(action)
        state = native.state()
        going = running & ~dones  # an environment that is done shows its next episode already
        errors.append((planar_velocity(state["v"]) - command)[going])
        ended |= {i: infos[i] for i in np.flatnonzero(running & dones)}
        running &= ~dones
    return _summary(np.concatenate(errors), list(ended.values()), period)


def planar_velocity(v: np.ndarray) -> np.ndarray:
    """Forward and lateral speed [m/s] and yaw rate [rad/s] of the base, shape (n, 3); `v` has angular part first."""
    return np.stack([v[:, 3], v[:, 4], v[:, 2]], axis=1)


def tracking(errors: np.ndarray) -> dict[str, float]:
    """Means of how far velocities (n, 3) are from those commanded, by name; not a number if there are none."""
    if not len(errors):
        errors = np.full((1, 3), np.nan)
    forward, lateral, yaw = np.abs(errors).mean(axis=0).tolist()
    velocity = float(np.hypot(errors[:, 0], errors[:, 1]).mean())
    return {"forward_error": forward, "lateral_error": lateral, "yaw_rate_error": yaw, "velocity_error": velocity}


def _summary(errors: np.ndarray, ended: list[dict[str, Any]], period: float) -> dict[str, float]:
    """Means over steps (errors) and over episodes (the rest)."""
    episodes = [info["episode"] for info in ended]
    mean = {key: float(np.mean([episode[key] for episode in episodes])) for key in episodes[0] if key != "t"}
    timed_out = np.array([info["TimeLimit.truncated"] for info in ended])
    diverged = np.array([info["diverged"] for info in ended])
    return {
        **tracking(errors),
        "falls": float(np.mean(~timed_out & ~diverged)),
        "timed_out": float(np.mean(timed_out & ~diverged)),
        "diverged": float(np.mean(diverged)),
        "episode_length": mean.pop("l") * period,
        "reward": mean.pop("r"),
        "episodes": len(ended),
        **mean,
    }


def report(result: dict[str, Any]) -> str:
    """The figures that matter, one per line; those of motors and pushes if they are there."""
    rows = [
        ("forward speed error", f"{result['forward_error']:.3f} m/s", "mean absolute, over every step"),
        ("lateral speed error", f"{result['lateral_error']:.3f} m/s", ""),
        ("yaw rate error", f"{result['yaw_rate_error']:.3f} rad/s", ""),
        ("velocity error", f"{result['velocity_error']:.3f} m/s", "horizontal, mean length"),
        ("falls", f"{result['falls']:.1%}", f"of {result['episodes']} episodes"),
        ("time-outs", f"{result['timed_out']:.1%}", "on its feet to the end"),
        ("episode length", f"{result['episode_length']:.1f} s", "mean"),
        ("reward per episode", f"{result['reward']:.2f}", ""),
    ]
    if result["diverged"]:
        rows.append(("diverged", f"{result['diverged']:.1%}", "stopped because numbers went astray"))
    lines = [f"{name:<20} {figure:<12} {note}".rstrip() for name, figure, note in rows + _effort_rows(result)]
    return "\n".join(lines) + (f"\n\n{push_table(result['pushes'])}" if "pushes" in result else "")


def _effort_rows(result: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What the motors do, or nothing if nobody watched them."""
    found = result.get("effort")
    if not found:
        return []
    rows = [("power", f"{found['power']:.0f} W", f"of driving motors, at {found['speed']:.2f} m/s")]
    if found["cost_of_transport"] is not None:
        net = f"braking lost; {found['cost_of_transport_net']:.2f} if it is taken back"
        rows.append(("cost of transport", f"{found['cost_of_transport']:.2f}", net))
    for what in ("torque", "power"):
        if found[f"mean_{what}"] is not None:
            figures = f"{found[f'mean_{what}']:.0%}, {found[f'peak_{what}']:.0%}"
            rows.append((f"motor {what}", figures, f"of its limit, mean and peak ({found[f'peak_{what}_at']})"))
    return rows


def add_env_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--env`, for `load`."""
    text = (
        "environment to act in, such as my_module:ce_gym/MyRobotVelocity-v0 (default: as trained); a module that only "
    )
    parser.add_argument("--env", metavar="ID", help=text + "the policy's file names is not imported")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments shared by the programs that judge policies, apart from the policies and `--env`."""
    parser.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes, side by side (default 256)"
    )
    parser.add_argument("--seed", type=SEED, default=EVALUATION_SEED, help="seed of the first episode")
    add_json_argument(parser)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(
        description="Judge a trained policy: tracking errors, falls, what it asks of the motors, how hard it can be "
        "pushed. Torques and powers are those of sub-steps, as shares of what the motors can give."
    )
    parser.add_argument("policy", help=WHERE)
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature or none (default: as trained)"
    )
    parser.add_argument("--pushes", action="store_true", help="also push it, from all sides, harder and harder")
    add_env_argument(parser)
    add_arguments(parser)
    args = parser.parse_args(argv)
    return run("evaluate.py", lambda: _judge(args))


def _judge(args: argparse.Namespace) -> int:
    """Do everything that the command line asks for."""
    model = load(args.policy, args.env, args.transmission)
    kwargs = env_kwargs(model.record, args.transmission)
    result: dict[str, Any] = evaluate(model, model.record["env"], episodes=args.episodes, seed=args.seed, **kwargs)
    if found := effort(model, episodes=min(args.episodes, 32), seed=args.seed, **kwargs):
        result["effort"] = found
    if args.pushes:
        result["pushes"] = push_envelope(model, seed=args.seed, **kwargs)
    print_result(result, report(result), args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
