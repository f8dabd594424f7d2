"""Judge a trained policy: how well it follows its commands, and how often it falls.

Every environment of a batch plays exactly one whole episode, so that short episodes do not count more often than
long ones. Uses public names of ce_gym only, and no name of a robot or task.

    python train/evaluate.py runs/mini_cheetah_velocity/policy.zip --transmission armature
    python train/evaluate.py policy.onnx
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from policy_file import Policy, PolicyError, read_policy
from stable_baselines3 import PPO

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env

EVALUATION_SEED = 1_000_000
"""Far from training seeds, so that a policy is judged on commands and starts it has not met."""


def load_policy(path: str | Path) -> tuple[PPO, dict[str, Any]]:
    """Read a policy with all that training it on needs, and the record that training wrote beside it.

    Only for files you trust: Stable-Baselines3 unpickles objects, which can run any code. To judge or show a policy,
    `policy_file.read_policy` reads its weights and nothing else.

    Args:
        path: Of the policy, `<name>.zip`; its record is `<name>.json`.

    Returns:
        The policy and its record: environment, transmission level, steps, seed and so on.

    Raises:
        PolicyError: If one of the two files is missing or damaged.
    """
    policy = Path(path).with_suffix(".zip")
    for file in (policy, policy.with_suffix(".json")):
        if not file.exists():
            raise PolicyError(
                f"{file}: no such file; expected a policy.zip and its policy.json as training writes them"
            )
    try:
        record = json.loads(policy.with_suffix(".json").read_text(encoding="utf-8"))
        return PPO.load(policy, device="cpu"), record
    except Exception as error:
        raise PolicyError(f"{policy}: not a policy that can be read: {error}") from None


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
        actual base velocity, in base coordinates, over every step of every episode. falls, diverged: fraction of
        episodes that ended early, and that were stopped because the state was no longer finite. episode_length [s],
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
        errors.append(np.abs(_planar_velocity(state["v"]) - command)[going])
        ended |= {i: infos[i] for i in np.flatnonzero(running & dones)}
        running &= ~dones
    return _summary(np.concatenate(errors), list(ended.values()), period)


def _planar_velocity(v: np.ndarray) -> np.ndarray:
    """Forward and lateral speed [m/s] and yaw rate [rad/s] of the base, shape (n, 3); `v` has angular part first."""
    return np.stack([v[:, 3], v[:, 4], v[:, 2]], axis=1)


def _summary(errors: np.ndarray, ended: list[dict[str, Any]], period: float) -> dict[str, float]:
    """Means over steps (errors) and over episodes (the rest)."""
    forward, lateral, yaw = errors.mean(axis=0).tolist()
    episodes = [info["episode"] for info in ended]
    mean = {key: float(np.mean([episode[key] for episode in episodes])) for key in episodes[0] if key != "t"}
    timed_out = np.array([info["TimeLimit.truncated"] for info in ended])
    diverged = np.array([info["diverged"] for info in ended])
    return {
        "forward_error": forward,
        "lateral_error": lateral,
        "yaw_rate_error": yaw,
        "falls": float(np.mean(~timed_out & ~diverged)),
        "diverged": float(np.mean(diverged)),
        "episode_length": mean.pop("l") * period,
        "reward": mean.pop("r"),
        "episodes": len(ended),
        **mean,
    }


def report(result: dict[str, float]) -> str:
    """The figures that matter, one per line."""
    return "\n".join(
        [
            f"forward speed error  {result['forward_error']:.3f} m/s    (mean absolute, over every step)",
            f"lateral speed error  {result['lateral_error']:.3f} m/s",
            f"yaw rate error       {result['yaw_rate_error']:.3f} rad/s",
            f"falls                {100 * result['falls']:.1f} % of {result['episodes']} episodes",
            f"episode length       {result['episode_length']:.1f} s",
            f"reward per episode   {result['reward']:.2f}",
        ]
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments shared by the programs that judge a policy."""
    parser.add_argument("policy", help="policy.zip of train/ppo.py, its policy.json beside it, or .onnx of export.py")
    parser.add_argument("--episodes", type=int, default=256, metavar="N", help="episodes, side by side (default 256)")
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="seed of the first episode")
    parser.add_argument("--json", action="store_true", help="print the result as JSON and nothing else")


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Judge a trained policy: tracking errors, falls, episode length.")
    add_arguments(parser)
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature or none (default: as trained)"
    )
    args = parser.parse_args(argv)
    try:
        model = read_policy(args.policy, args.transmission)
        kwargs = env_kwargs(model.record, args.transmission)
        result = evaluate(model, model.record["env"], episodes=args.episodes, seed=args.seed, **kwargs)
    except ValueError as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result, indent=2) if args.json else report(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
