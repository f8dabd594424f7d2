# pyright: reportMissingImports=false
"""Train a policy with RLlib's PPO: several processes, each with a native batch, on one machine or a cluster.

Needs the extra `ray` in a separate virtual environment, see docs/how-to/learners.md. Settings files are the same as for
`python -m ce_gym train`; `num_envs` counts the environments of all processes together. The policy is written as
`policy.npz`, which `python -m ce_gym evaluate`, `play` and the other commands read.

    python train/rllib.py ce_gym/MiniCheetahVelocity-v0 --env-runners 2 --seconds 60
    python train/rllib.py ce_gym/MiniCheetahVelocity-v0 --env-runners 2 --resume
"""

from __future__ import annotations

# isort: split

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import ray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from ce_gym.__main__ import run
from ce_gym.console import SEED, THREADS, Parser, above_zero, add_force_argument, path, whole
from ce_gym.files import set_force
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.runs.folder import remove, run_folder, unused_folder
from ce_gym.learn.runs.job import Job, basic_record
from ce_gym.learn.runs.settings import Settings, SettingsError, config_file
from ce_gym.learn.training import make_job
from ce_gym.policies import Actor, add_env_arg, keep_map, write_npz

CHECKPOINT_PERIOD = 60.0
"""Time between two checkpoints [s]."""


def algorithm(env_id: str, s: Settings, runners: int, learners: int = 0, seed: int = 0, **env_kwargs: Any) -> Algorithm:
    """Return RLlib's PPO with the given settings, except `final_std`, `final_entropy` and `fall_cost`.

    Args:
        env_id: Registered environment id.
        s: Settings. A penalty keeps the divergence near `target_kl`; if that is 0, the learning rate falls.
        runners: Number of processes that step environments; 0 uses this process.
        learners: Number of processes that learn; 0 uses this process.
        seed: Seed of all random numbers.
        **env_kwargs: Arguments of the environments.

    Raises:
        SettingsError: If the environments cannot be divided among the processes.
    """
    if s.num_envs % max(runners, 1):
        raise SettingsError(f"num_envs: {s.num_envs}; expected a multiple of the {runners} env runners")
    samples = s.num_envs * s.rollout
    config = (
        PPOConfig()
        .environment(importable(env_id), env_config=env_kwargs, disable_env_checking=True)
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=s.num_envs // max(runners, 1),
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=s.rollout,
        )
        .learners(num_learners=learners)
        .training(
            train_batch_size_per_learner=samples // max(learners, 1),
            minibatch_size=samples // s.minibatches // max(learners, 1),
            num_epochs=s.epochs,
            lr=s.learning_rate if s.target_kl else [[0, s.learning_rate], [s.steps, 0.0]],
            gamma=s.gamma,
            lambda_=s.gae_lambda,
            clip_param=s.clip,
            entropy_coeff=s.entropy,
            vf_loss_coeff=s.value,
            vf_clip_param=float("inf"),
            grad_clip=s.max_grad_norm,
            use_kl_loss=s.target_kl > 0,
            kl_target=s.target_kl,
        )
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=list(s.hidden),
                fcnet_activation=s.activation.lower(),
                vf_share_layers=False,
                free_log_std=True,
                log_std_clip_param=float("inf"),
            )
        )
        .fault_tolerance(restart_failed_env_runners=True)
        .debugging(seed=seed, log_level="ERROR")
    )
    return config.build_algo()


def importable(env_id: str) -> str:
    """Return an id that works in every process: `module:id` imports the module that registers the environment."""
    return env_id if ":" in env_id else f"ce_gym:{env_id}"


def set_initial_std(algo: Algorithm, std: float) -> None:
    """Set the standard deviation of the actions in every process; RLlib starts with 1."""

    def set_weights(weights: dict[str, Any]) -> None:
        for name in weights:
            if name.endswith("log_std"):
                weights[name] = np.full_like(weights[name], np.log(std))

    state = algo.learner_group.get_weights()
    for weights in state.values():
        set_weights(weights)
    algo.learner_group.set_weights(state)
    algo.env_runner_group.sync_weights(from_worker_or_learner_group=algo.learner_group)


def actor_of(algo: Algorithm, activation: str) -> Actor:
    """Return the layers of an algorithm's actor up to the mean action; `activation` as in torch.nn."""
    weights = next(iter(algo.learner_group.get_weights().values()))
    layers = [
        (np.asarray(weights[name], np.float32), np.asarray(weights[name.removesuffix("weight") + "bias"], np.float32))
        for name in weights
        if name.endswith("weight") and ("actor_encoder" in name or name.startswith("pi."))
    ]
    return Actor(tuple(layers), activation)


def train(algo: Algorithm, steps: float, seconds: float, folder: Path | None = None) -> int:
    """Train for a number of environment steps or a time [s], and return the steps done.

    If an env runner or its node fails, training continues with the others, and with a new one as soon as the cluster
    has room.

    Args:
        algo: The algorithm; after a restoration, its earlier steps count.
        steps: Environment steps.
        seconds: Longest time [s].
        folder: Folder of a checkpoint that is written about once a minute; None writes none.
    """
    start, saved, done = time.monotonic(), time.monotonic(), 0
    while done < steps and time.monotonic() - start < seconds:
        result = algo.train()
        figures, passed = result["env_runners"], time.monotonic() - start
        done = int(figures["num_env_steps_sampled_lifetime"])
        print(
            f"{passed:6.0f} s  {done / 1e6:6.2f} M steps  {result['fault_tolerance']['num_healthy_workers']} runners  "
            f"reward {figures.get('episode_return_mean', float('nan')):7.2f}  "
            f"length {figures.get('episode_len_mean', float('nan')):6.1f}",
            flush=True,
        )
        if folder and time.monotonic() - saved > CHECKPOINT_PERIOD:
            algo.save_to_path(str(folder.resolve()))
            saved = time.monotonic()
    return done


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Train a policy with RLlib's PPO.")
    parser.add_argument("env", metavar="ENV", help="environment id, such as ce_gym/MiniCheetahStand-v0")
    parser.add_argument("--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic")
    add_env_arg(parser)
    parser.add_argument(
        "--env-runners", type=whole(0, 10_000), default=2, metavar="N", help="processes that step (default 2)"
    )
    parser.add_argument(
        "--learners", type=whole(0, 1000), default=0, metavar="N", help="processes that learn (default: this one)"
    )
    parser.add_argument("--threads", type=THREADS, default=1, metavar="N", help="threads of each process (default 1)")
    parser.add_argument("--address", metavar="HOST:PORT", help="cluster to connect to; 'auto' for this node's own")
    parser.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    parser.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    parser.add_argument(
        "--seconds", type=above_zero, default=float("inf"), metavar="T", help="longest training time [s]"
    )
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change")
    parser.add_argument("--out", type=path, metavar="FOLDER", help="default: runs/<name of the settings file>-rllib")
    add_force_argument(parser)
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint in the folder")
    args = parser.parse_args(argv)
    return run(in_one_line(lambda: _work(args)))


def _work(args: argparse.Namespace) -> int:
    """Train, write the policy, and print its path."""
    set_force(args.force)
    settings = [*args.set, *([f"steps={args.steps}"] if args.steps else [])]
    level = {"transmission": args.transmission} if args.transmission else {}
    job = make_job(args.env, settings=settings, env_kwargs={**level, **dict(args.env_args)}, seed=args.seed)
    default = Path("runs") / "-".join(filter(None, (config_file(args.env).stem, args.transmission, "rllib")))
    out = args.out or (default if args.resume else unused_folder(default))
    checkpoint = out / "checkpoint"
    if args.resume and not checkpoint.exists():
        raise SettingsError(f"--resume: {checkpoint}: no such folder; expected the checkpoint of an earlier run")
    with run_folder(out, checkpoint if args.resume else None) as replaced:
        _train(args, job, out, checkpoint, replaced)
    print(out / "policy.npz")
    return 0


def _train(args: argparse.Namespace, job: Job, out: Path, checkpoint: Path, replaced: list[Path]) -> None:
    """Train, and write the policy."""
    s = job.settings
    env = gymnasium.make_vec(args.env, num_envs=1, **job.env_kwargs)  # errors in one line; fills the kernel cache
    ray.init(address=args.address, log_to_driver=False, include_dashboard=False)
    options = {**job.env_kwargs, **s.training, "num_threads": args.threads}
    algo = algorithm(args.env, s, args.env_runners, args.learners, args.seed, **options)
    if args.resume:
        algo.restore_from_path(str(checkpoint.resolve()))
    else:
        set_initial_std(algo, s.initial_std)
    remove(replaced)
    keep_map(job.env_kwargs, out)
    steps = train(algo, s.steps, args.seconds, checkpoint)
    algo.save_to_path(str(checkpoint.resolve()))
    record = basic_record(env.unwrapped, args.env, job.env_kwargs, s) | {"steps": steps}
    write_npz(actor_of(algo, s.activation), record, out / "policy.npz")
    algo.stop()


if __name__ == "__main__":
    raise SystemExit(main())
