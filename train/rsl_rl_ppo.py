"""Train a policy with rsl_rl's PPO: any registered environment, with the settings files of `python -m ce_gym train`.

The output folder has rsl_rl's checkpoints and TensorBoard logs, and the policy as `policy.npz`, which `python -m ce_gym
evaluate`, `transfer`, `sim2sim`, `export` and `play` read. Needs the extra `rsl-rl`.

    python train/rsl_rl_ppo.py ce_gym/MiniCheetahVelocity-v0 --steps 6e6
    python train/rsl_rl_ppo.py ce_gym/MiniCheetahVelocity-v0 --critic contact_forces base_height
    python train/rsl_rl_ppo.py ce_gym/MiniCheetahVelocity-v0 --device cuda --set num_envs=4096
    python train/rsl_rl_ppo.py --resume runs/mini_cheetah_velocity-rsl_rl --steps 12e6
"""

from __future__ import annotations

# isort: split

import argparse
import contextlib
import math
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from ce_gym.__main__ import run
from ce_gym.adapters.rsl_rl import make_rsl_rl_vec_env
from ce_gym.console import EPISODES, SEED, Parser, add_force_argument, path
from ce_gym.files import set_force
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.evaluation.evaluation import evaluate, report
from ce_gym.learn.runs.folder import remove, run_folder, unused_folder
from ce_gym.learn.runs.job import Job, Trained, acting_environment, make_record
from ce_gym.learn.runs.progress import StopInOrder
from ce_gym.learn.runs.settings import Settings, config_file
from ce_gym.learn.training import make_job
from ce_gym.policies import Actor, Policy, PolicyError, add_env_arg, keep_map, locate_policy, write_npz

DIVERGENCE = 0.01
"""KL divergence that is usual with rsl_rl, for settings with `target_kl` 0; rsl_rl has no linear decay of the rate."""


def runner_settings(s: Settings, groups: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return settings in the form of rsl_rl's runner; `groups` are the observation groups.

    rsl_rl has no schedules for the entropy bonus, the noise and the cost of falls. So the weight of the entropy bonus
    is constant, the noise is learned, and falls have no cost. The learning rate follows the KL divergence.
    """
    network = {"class_name": "MLPModel", "hidden_dims": list(s.hidden), "activation": s.activation.lower()}
    spread = {"class_name": "GaussianDistribution", "init_std": s.initial_std, "std_type": "log"}
    return {
        "seed": seed,
        "num_steps_per_env": s.rollout,
        "save_interval": max(iterations(s) // 10, 1),
        "obs_groups": {"actor": ["policy"], "critic": ["critic" if "critic" in groups else "policy"]},
        "actor": network | {"distribution_cfg": spread},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": s.epochs,
            "num_mini_batches": s.minibatches,
            "clip_param": s.clip,
            "gamma": s.gamma,
            "lam": s.gae_lambda,
            "value_loss_coef": s.value,
            "entropy_coef": s.entropy,
            "learning_rate": s.learning_rate,
            "max_grad_norm": s.max_grad_norm,
            "schedule": "adaptive",
            "desired_kl": s.target_kl or DIVERGENCE,
        },
    }


def iterations(s: Settings) -> int:
    """Return the number of rollouts of a training."""
    return math.ceil(s.steps / (s.num_envs * s.rollout))


def restore(runner: OnPolicyRunner, folder: Path) -> None:
    """Continue from the last checkpoint in a folder: networks, optimiser, learning rate and number of iterations.

    Raises:
        PolicyError: If there is no checkpoint, or it has other networks. No code in it is run.
    """
    checkpoints = sorted(folder.glob("model_*.pt"), key=lambda file: int(file.stem.removeprefix("model_")))
    if not checkpoints:
        raise PolicyError(f"{folder}: has no model_*.pt; expected the folder of a run of train/rsl_rl_ppo.py")
    try:
        state = torch.load(checkpoints[-1], map_location=runner.device, weights_only=True)
        runner.alg.load(state, None, strict=True)
        runner.current_learning_iteration = state["iter"] + 1
    except Exception as error:  # damaged files raise errors of many classes
        text = " ".join(str(error).split())[:200]
        raise PolicyError(f"{checkpoints[-1]}: training cannot continue: {text}") from None


def train(job: Job, device: str = "cpu") -> Trained:
    """Train, and save the policy even if a signal ends training early; the iteration is finished first.

    Raises:
        OSError: If the folder has another run or another owner, or cannot be written.
        PolicyError: If the run to resume does not fit the environment or the settings.
    """
    with run_folder(job.out, job.resume) as replaced:
        return _train(job, device, replaced)


def _train(job: Job, device: str, replaced: list[Path]) -> Trained:
    s, file = job.settings, job.out / "policy.npz"
    keep_map(job.env_kwargs, job.out)
    torch.manual_seed(job.seed)
    envs = make_rsl_rl_vec_env(job.env_id, s.num_envs, job.seed, device, **{**job.env_kwargs, **s.training})
    groups = tuple(map(str, envs.get_observations().keys()))
    runner = OnPolicyRunner(envs, runner_settings(s, groups, job.seed), str(job.out), device=device)
    if job.resume:
        restore(runner, job.resume.parent)
    native, log = acting_environment(job, envs.envs.unwrapped), runner.logger.log

    def save(done: int, finished: bool) -> Trained:
        record = make_record(job, native, done * s.num_envs * s.rollout, ("rsl-rl-lib", "torch"))
        policy = Policy(actor_of(runner, s.activation), record | {"finished": finished})
        write_npz(policy.act, policy.record, file)  # type: ignore[arg-type]
        return Trained(policy, policy.record, file, not finished)

    def log_and_stop(**figures: Any) -> None:
        log(**figures)  # the last call of an iteration
        if stop.due:
            raise KeyboardInterrupt

    remove(replaced)
    done = runner.current_learning_iteration
    trained = save(done, done >= iterations(s))  # with the settings, which a killed run needs to continue
    if done < iterations(s):
        runner.logger.log = log_and_stop  # type: ignore[method-assign]
        with StopInOrder() as stop, contextlib.suppress(KeyboardInterrupt):
            stop.has_progress = True  # the policy is saved already
            runner.learn(iterations(s) - done, init_at_random_ep_len=True)
        done = runner.current_learning_iteration + 1
        runner.save(str(job.out / f"model_{done - 1}.pt"))
        trained = save(done, not stop.interrupted)
    envs.close()
    return trained


def actor_of(runner: OnPolicyRunner, activation: str) -> Actor:
    """Return the layers of a runner's actor; `activation` as in torch.nn."""
    modules = runner.alg.get_policy().mlp.modules()
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    return Actor(tuple((x.weight.detach().cpu().numpy(), x.bias.detach().cpu().numpy()) for x in linear), activation)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Train a policy with rsl_rl's PPO.")
    parser.add_argument("env", nargs="?", default="", metavar="ENV", help="id, such as ce_gym/MiniCheetahStand-v0")
    parser.add_argument("--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic")
    parser.add_argument("--critic", nargs="+", metavar="BLOCK", help="observation blocks that only the critic sees")
    add_env_arg(parser)
    parser.add_argument("--resume", type=path, metavar="FOLDER", help="run to continue; --steps includes its steps")
    parser.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    parser.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help="settings to change")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda for networks and physics on a GPU (default cpu)")
    parser.add_argument("--out", type=path, metavar="FOLDER", help="default: runs/<name of the settings file>-rsl_rl")
    add_force_argument(parser)
    parser.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes of the evaluation at the end"
    )
    args = parser.parse_args(argv)
    return run(in_one_line(lambda: _work(args)))


def _work(args: argparse.Namespace) -> int:
    """Train, write and evaluate the policy, and print its path."""
    set_force(args.force)
    kwargs: dict[str, Any] = {"dtype": "float32"} if args.device.startswith("cuda") else {}
    kwargs |= {"transmission": args.transmission} if args.transmission else {}
    kwargs |= {"obs_mode": "dict", "critic": args.critic} if args.critic else {}
    default = Path("runs") / f"{config_file(args.env).stem}-rsl_rl"
    folder = locate_policy(args.resume).parent if args.resume else unused_folder(default)
    job = make_job(
        args.env,
        "ppo",
        out=args.out or folder,
        seed=args.seed,
        settings=[*args.set, *([f"steps={args.steps}"] if args.steps else [])],
        env_kwargs=kwargs | dict(args.env_args),
        resume=args.resume,
    ).replace(algo="rsl_rl")
    trained = train(job, args.device)
    if trained.interrupted:
        print(f"interrupted; continue with: python train/rsl_rl_ppo.py --resume {job.out}")
        return 130
    print(report(evaluate(trained.model, job.env_id, episodes=args.episodes, **job.env_kwargs)))
    print(trained.policy)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
