"""Let a trained policy drive one robot through a list of commands, and record it for the viewer.

Uses public names of ce_gym only, and no name of a robot or task.

    python train/record.py runs/mini_cheetah_velocity/policy.zip --command 4 1 0 0 --command 4 0 0 1.5
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from evaluate import EVALUATION_SEED, env_kwargs
from policy_file import Policy, read_policy
from stable_baselines3 import PPO

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.viewer import Recorder, Rollout, write_html

Script = Sequence[tuple[float, tuple[float, float, float]]]
"""Commands one after the other: for how long [s], then forward, lateral [m/s] and yaw rate [rad/s]."""

SHOW: Script = (
    (1.0, (0.0, 0.0, 0.0)),
    (4.0, (0.8, 0.0, 0.0)),
    (4.0, (0.5, 0.0, 1.0)),
    (3.0, (0.0, 0.4, 0.0)),
    (4.0, (1.0, 0.0, 0.0)),
    (1.0, (0.0, 0.0, 0.0)),
)
"""Stand, walk, turn, step sideways, walk faster, stand."""


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
    # Commands come from the script: the environment draws no new ones before the end of time.
    envs = make_sb3_vec_env(env_id, 1, seed, contact_forces=True, command_period=1e6, **kwargs)
    try:
        native: Any = envs.envs.unwrapped
        period = 1.0 / native.metadata["render_fps"]
        commands = np.repeat([c for _, c in script], [round(t / period) for t, _ in script], axis=0)
        names = native.contact_names
        robot = native.model.robot.name
        recorder = Recorder(robot, native.model.transmission, period, label=label, contact_names=names)
        obs, done = envs.reset(), np.zeros(1, bool)
        for step, command in enumerate(commands):
            native.set_command(command)
            _add_frame(recorder, step * period, native.state())
            action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
            obs, _, done, _ = envs.step(action)
            if done[0]:
                break
        return recorder.rollout()
    finally:
        envs.close()


def _add_frame(recorder: Recorder, time: float, state: dict[str, np.ndarray]) -> None:
    """Record the state of the first environment at `time` [s]."""
    recorder.add(time, *(state[key][0] for key in ("q", "v", "contact_forces", "command")))


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = argparse.ArgumentParser(description="Record a trained policy for the viewer: an npz and an HTML page.")
    parser.add_argument("policy", help="policy.zip of train/ppo.py or .onnx of train/export.py")
    parser.add_argument(
        "--command", nargs=4, type=float, action="append", metavar=("SECONDS", "FORWARD", "LATERAL", "YAW"),
        help="what to command, and for how long; may be given several times (default: a short show)",
    )  # fmt: skip
    parser.add_argument(
        "--transmission", metavar="LEVEL", help="exact, coupled, armature or none (default: as trained)"
    )
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="seed of the environment")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="npz to write (default: rollout.npz beside the policy)"
    )
    args = parser.parse_args(argv)
    script = [(t, (vx, vy, yaw)) for t, vx, vy, yaw in args.command] if args.command else SHOW
    out = args.out or Path(args.policy).parent / "rollout.npz"
    try:
        model = read_policy(args.policy, args.transmission)
        kwargs = env_kwargs(model.record, args.transmission)
        rollout = record(model, model.record["env"], script, seed=args.seed, **kwargs)
        rollout.save(out)
    except ValueError as error:
        print(f"record.py: {error}", file=sys.stderr)
        return 2
    write_html([rollout], out.with_suffix(".html"))
    print(f"{out}\n{out.with_suffix('.html')}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
