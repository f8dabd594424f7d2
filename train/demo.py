"""Train a robot, evaluate it, and show it in a browser, in one command.

A second call uses the finished policy, or continues an interrupted training; `--force` starts again.

    python train/demo.py
"""

from __future__ import annotations

# isort: split

import argparse
from pathlib import Path

import numpy as np

from ce_gym.__main__ import run
from ce_gym.console import EPISODES, SEED, STEPS, Parser, above_zero, add_threads_argument, path
from ce_gym.files import set_force
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.evaluation.episodes import EVALUATION_SEED
from ce_gym.learn.evaluation.evaluation import report
from ce_gym.learn.evaluation.transfer import summary, table, transfer
from ce_gym.learn.runs.job import Trained
from ce_gym.learn.training import make_job, run_job
from ce_gym.policies import add_env_arg, load_policy, with_map
from ce_gym.viewer import Rollout, walk, write_html

ENV = "ce_gym/MiniCheetahVelocity-v0"


def obtain_policy(args: argparse.Namespace) -> Path:
    """Return the policy in the output folder, trained now if necessary, and print which."""
    set_force(args.force)
    job = make_job(
        args.env, out=args.out, seed=args.seed, settings={"steps": args.steps} if args.steps else {},
        env_kwargs=dict(args.env_args), threads=args.threads, seconds=args.seconds,
    )  # fmt: skip
    policy = args.out / "policy.npz"
    if policy.exists() and not args.force:
        record = load_policy(policy).record
        same = (record["env"], record["env_kwargs"]) == (args.env, with_map(job.env_kwargs, policy))
        if record.get("finished") and same:
            print(f"Using the policy trained earlier: {policy}, {record['steps']:,} steps. --force trains a new one.")
            return policy
        job = job.replace(resume=policy if same else None)
    begin = f"Continuing {policy}" if job.resume else "Training a new policy"
    length = f"{job.settings.steps:,} steps or {args.seconds:g} s"
    print(f"{begin}: {args.env}, {length}. Ctrl-C stops and keeps the policy.")
    return _announce(run_job(job))


def _announce(trained: Trained) -> Path:
    """Print steps and time of training, and return the policy."""
    seconds, steps = trained.record["training_seconds"], trained.record["steps"]
    how = "Interrupted" if trained.interrupted else "Trained"
    print(f"{how}: {steps:,} steps, {seconds:.0f} s. Policy: {trained.policy}")
    return trained.policy


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Train a robot on exact transmissions, evaluate it, and show it.")
    parser.add_argument("--env", default=ENV, metavar="ID", help=f"environment id (default {ENV})")
    add_env_arg(parser)
    parser.add_argument("--force", action="store_true", help="train a new policy even if an earlier run left one")
    parser.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    parser.add_argument("--steps", type=STEPS, metavar="N", help="environment steps (default: as in the settings file)")
    parser.add_argument(
        "--seconds", type=above_zero, default=240.0, metavar="T", help="longest training time [s] (default 240)"
    )
    add_threads_argument(parser)
    parser.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes of the evaluation (default 256)"
    )
    parser.add_argument("--out", type=path, default=Path("demo"), metavar="FOLDER", help="default: demo")
    args = parser.parse_args(argv)
    return run(in_one_line(lambda: show(obtain_policy(args), args.episodes, args.out, args.env)))


def show(policy: Path, episodes: int, out: Path, env: str | None = None) -> int:
    """Print the results of a policy at every transmission level, and write a rollout and its page.

    The page also shows a ghost: the policy at level `none`, or at `exact` if it was trained at a simplified level.

    Args:
        policy: File of the policy.
        episodes: Episodes of the evaluation.
        out: Folder to write to.
        env: Environment id from the command line; see `ce_gym.policies.environment_of`.
    """
    model = load_policy(policy)
    level = model.record["transmission"]
    results = transfer(model, model.record, episodes=episodes)
    entry = {"transmission": level, "results": results}
    print(f"\nEvaluated on {level} transmissions:\n{report(results[level])}")
    print(f"\nThe same policy on every transmission level:\n{table(summary([entry]))}")
    (rollout,), (ghost,) = (
        walk(policy, env=env, seed=EVALUATION_SEED, transmission=shown, label=f"{shown} transmissions, {what}")
        for shown, what in ((level, "as trained"), ("none" if level == "exact" else "exact", "the ghost"))
    )
    page = out / f"{rollout.robot}.html"
    rollout.save(page.with_suffix(".npz"))
    write_html([rollout, ghost], page, spacing=0.0)
    print(f"\nRecorded {rollout.duration:.1f} s. {parting(rollout, ghost)}")
    print(f"Open this page in a browser:\n{page.resolve()}")
    return 0


def parting(rollout: Rollout, ghost: Rollout) -> str:
    """Return a sentence about the ghost and its distance from the robot when the shorter rollout ends."""
    last = min(len(rollout), len(ghost)) - 1
    distance = np.linalg.norm(rollout.q[last, :2] - ghost.q[last, :2])
    what = f"The ghost is the same policy from the same seed on {ghost.transmission} transmissions"
    return f"{what}; after {rollout.times[last]:.1f} s it is {distance:.2f} m away."


if __name__ == "__main__":
    raise SystemExit(main())
