"""Let a trained policy drive one robot through a list of commands, and record it for the viewer.

Uses public names of ce_gym only, and no name of a robot or task.

    python train/record.py runs/mini_cheetah_velocity/policy.zip --command 4 1 0 0 --command 4 0 0 1.5
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from console import run
from evaluate import EVALUATION_SEED, env_kwargs
from stable_baselines3 import PPO

from ce_gym.policies import WHERE, Policy, load_policy, locate_policy, shelf
from ce_gym.viewer import SHOW, Rollout, Script, drive, write_html


def record(
    model: PPO | Policy,
    env_id: str,
    script: Script = SHOW,
    *,
    seed: int = EVALUATION_SEED,
    label: str = "",
    **kwargs: Any,
) -> Rollout:
    """Drive one environment with the policy's mean action and record every step.

    Recording ends with the script, or with the episode should the robot fall.

    Args:
        model: The policy.
        env_id: Registered environment id.
        script: What to command.
        seed: Of the environment.
        label: A few words for the viewer's legend.
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        One frame per step of the environment.
    """

    def act(observation: Any) -> np.ndarray:
        return model.predict(observation, deterministic=True)[0]  # type: ignore[arg-type]

    return drive(act, env_id, script, seed=seed, label=label, **kwargs)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Record a trained policy for the viewer: an npz and an HTML page.")
    parser.add_argument("policy", help=WHERE)
    parser.add_argument(
        "--command", nargs=4, type=float, action="append", metavar=("SECONDS", "FORWARD", "LATERAL", "YAW"),
        help="what to command, and for how long; may be given several times (default: a short show)",
    )  # fmt: skip
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature or none (default: as trained)"
    )
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="seed of the environment")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="npz to write (default: rollout.npz beside the policy; <name>.npz here if it is a shipped one)",
    )
    args = parser.parse_args(argv)
    return run("record.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Record, and write both files."""
    script = [(t, (vx, vy, yaw)) for t, vx, vy, yaw in args.command] if args.command else SHOW
    policy = locate_policy(args.policy)
    beside = Path(f"{policy.parent.name}.npz") if shelf() in policy.parents else policy.parent / "rollout.npz"
    out = args.out or beside
    model = load_policy(policy, args.transmission)
    kwargs = env_kwargs(model.record, args.transmission)
    rollout = record(model, model.record["env"], script, seed=args.seed, **kwargs)
    rollout.save(out)
    write_html([rollout], out.with_suffix(".html"))
    print(f"{out}\n{out.with_suffix('.html')}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
