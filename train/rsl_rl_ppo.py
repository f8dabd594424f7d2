"""Train a policy with rsl_rl's PPO: any registered environment, with the settings files of train/ppo.py.

Writes rsl_rl's checkpoints and TensorBoard logs to the output folder, and the policy as `policy.onnx` with its
specification. evaluate.py, transfer.py, sim2sim.py and `python -m ce_gym play` read this file. Needs the extra
`rsl-rl`. Uses public names of ce_gym only, and no name of a robot or task.

    python train/rsl_rl_ppo.py --env ce_gym/MiniCheetahVelocity-v0 --steps 6e6
    python train/rsl_rl_ppo.py --env ce_gym/MiniCheetahVelocity-v0 --critic contact_forces base_height
    python train/rsl_rl_ppo.py --env ce_gym/MiniCheetahVelocity-v0 --device cuda --set num_envs=4096
"""

from __future__ import annotations

# isort: split

import argparse
import math
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner

from ce_gym.__main__ import run
from ce_gym.adapters.rsl_rl import RslRlVecEnv, make_rsl_rl_vec_env
from ce_gym.console import EPISODES, SEED, Parser
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.learn.evaluation.evaluation import evaluate, report
from ce_gym.learn.runs.folder import make_folder
from ce_gym.learn.runs.job import Job, acting_environment, basic_record
from ce_gym.learn.runs.settings import Settings, config_file, load_env_args, load_settings, with_named
from ce_gym.policies import Actor, add_env_arg, keep_map, load_policy
from ce_gym.policies.onnx_writer import to_onnx, write_onnx

DIVERGENCE = 0.01
"""KL divergence that is usual with rsl_rl, for settings with `target_kl` 0; rsl_rl has no linear decay of the rate."""


def runner_settings(s: Settings, groups: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return settings in the form of rsl_rl's runner; `groups` are the observation groups.

    rsl_rl has no schedules for the entropy bonus, the noise and the cost of falls. So the weight of the entropy bonus
    is constant, the noise is learned, and falls have no cost. The learning rate follows the KL divergence.
    """
    network = {"class_name": "MLPModel", "hidden_dims": list(s.hidden), "activation": s.activation.lower()}
    spread = {"class_name": "GaussianDistribution", "init_std": s.initial_std, "std_type": "log"}
    iterations = math.ceil(s.steps / (s.num_envs * s.rollout))
    return {
        "seed": seed,
        "num_steps_per_env": s.rollout,
        "save_interval": max(iterations // 10, 1),
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


def train(envs: RslRlVecEnv, settings: Settings, seed: int, out: Path | None = None) -> OnPolicyRunner:
    """Train for the steps of the settings, and return the runner; log and save in `out` if it is given."""
    torch.manual_seed(seed)
    chosen = runner_settings(settings, tuple(map(str, envs.get_observations().keys())), seed)
    runner = OnPolicyRunner(envs, chosen, str(out) if out else None, device=str(envs.device))
    iterations = math.ceil(settings.steps / (settings.num_envs * settings.rollout))
    runner.learn(iterations, init_at_random_ep_len=True)
    return runner


def actor_of(runner: OnPolicyRunner, activation: str) -> Actor:
    """Return the layers of a runner's actor; `activation` as in torch.nn."""
    modules = runner.alg.get_policy().mlp.modules()
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    return Actor(tuple((x.weight.detach().cpu().numpy(), x.bias.detach().cpu().numpy()) for x in linear), activation)


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Train a policy with rsl_rl's PPO.")
    parser.add_argument("--env", required=True, metavar="ID", help="environment id, such as ce_gym/MiniCheetahStand-v0")
    parser.add_argument("--transmission", metavar="LEVEL", help="exact, coupled, armature, none or elastic")
    parser.add_argument("--critic", nargs="+", metavar="BLOCK", help="observation blocks that only the critic sees")
    add_env_arg(parser)
    parser.add_argument("--seed", type=SEED, default=0, metavar="N", help="random seed (default 0)")
    parser.add_argument("--steps", metavar="N", help="environment steps in all, such as 6e6")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings to change")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda for networks and physics on a GPU (default cpu)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="default: runs/<name of the settings file>-rsl_rl")
    parser.add_argument(
        "--episodes", type=EPISODES, default=256, metavar="N", help="episodes of the evaluation at the end"
    )
    args = parser.parse_args(argv)
    return run(in_one_line(lambda: _work(args)))


def _work(args: argparse.Namespace) -> int:
    """Train, write and evaluate the policy, and print its path."""
    path = config_file(args.env)
    kwargs: dict[str, Any] = {"dtype": "float32"} if args.device.startswith("cuda") else {}
    kwargs |= load_env_args(path) | ({"transmission": args.transmission} if args.transmission else {})
    kwargs |= ({"obs_mode": "dict", "critic": args.critic} if args.critic else {}) | dict(args.env_args)
    settings = load_settings(path, [*args.set, *([f"steps={args.steps}"] if args.steps else [])])
    settings = with_named(settings, dict(args.env_args))
    out = args.out or Path("runs") / f"{path.stem}-rsl_rl"
    make_folder(out)
    keep_map(kwargs, out)
    training = {**kwargs, **settings.training}
    envs = make_rsl_rl_vec_env(args.env, settings.num_envs, args.seed, args.device, **training)
    runner = train(envs, settings, args.seed, out)
    acting = acting_environment(Job("rsl_rl", args.env, settings, out, kwargs), envs.envs.unwrapped)
    record = basic_record(acting, args.env, kwargs, settings)
    write_onnx(to_onnx(actor_of(runner, settings.activation), record), record, out / "policy.onnx")
    policy = load_policy(out / "policy.onnx")
    print(report(evaluate(policy, args.env, episodes=args.episodes, **kwargs)))
    print(out / "policy.onnx")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
