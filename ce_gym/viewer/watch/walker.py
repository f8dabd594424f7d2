"""The robot of a training run, under its newest policy, in the environment that the policy is trained for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.policies import Policy, environment_of
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.rollouts.driving import made
from ce_gym.viewer.rollouts.scan import scans_of

POLICIES = ("policy.*", "present/policy.*", "checkpoints/policy_*")
"""Where a run keeps policies."""


def newest_policy(run: Path) -> Path | None:
    """Return the policy that a run wrote last; None if there is none yet."""
    found = [file for pattern in POLICIES for file in run.glob(pattern) if _is_policy(file)]
    return max(found, key=_written, default=None)


def _is_policy(file: Path) -> bool:
    return file.suffix in (".npz", ".zip") and not file.name.startswith(".") and not file.stem.endswith(".learner")


def _written(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # replaced or deleted meanwhile
        return 0.0


class Walker:
    """One robot that acts on its task's own commands; episodes end and begin as in training.

    Args:
        policy: The policy, with its record.
        env_id: Environment that the user named; that of the record if "".
        kwargs: Arguments of the environment that replace those of the record.

    Attributes:
        policy: The policy that acts; may be replaced by another one of the same environment.
        dt: Length of a control step [s].
        scene: What is drawn of it.

    Raises:
        PolicyError: The environment must be named by the user.
        ViewerError: It cannot be made, or is none of ce_gym.
    """

    def __init__(self, policy: Policy, env_id: str, kwargs: Mapping[str, Any]) -> None:
        env_id = environment_of(policy.record, env_id or None)
        options = {"command_curriculum": 1.0, **policy.record["env_kwargs"], **kwargs}
        self._env, native = made(env_id, 1, options)
        self.policy, self._native, self.dt = policy, native, native.dt
        self._observation, _ = self._env.reset(seed=0)
        program = native.batch.program
        self._model = program.model
        ground, scan = field_of(program.task.terrain), scans_of(program)
        self.scene = MovingScene(self._model, self._model.standing_q, terrain=ground, scan=scan)

    def fits(self, policy: Policy) -> bool:
        """Whether a policy acts in the same environment."""
        return all(policy.record[key] == self.policy.record[key] for key in ("env", "env_kwargs", "observation_size"))

    def step(self) -> None:
        """Carry out one control step."""
        self._observation, *_ = self._env.step(self.policy.predict(self._observation)[0])

    def moves(self) -> dict[str, list[float]]:
        """Return what has moved, see `MovingScene.moves`."""
        return self.scene.moves([self._model], [self._native.batch.rows("q")[0].astype(float)])

    def state(self) -> dict[str, Any]:
        """Return what the page says of it: what is commanded, and how fast it is [m/s, rad/s]."""
        command, v = (self._native.batch.rows(name)[0].astype(float) for name in ("command", "v"))
        moves = v[[3, 4, 2]] if self._model.robot.floating else np.zeros(3)
        return {"command": command.round(3).tolist(), "moves": moves.round(3).tolist()}

    def close(self) -> None:
        """Give back what the environment holds."""
        self._env.close()
