"""The robot of a training run, under the newest policy, in the environment of the training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.policies import Policy, environment_of
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.rollouts.driving import make_envs
from ce_gym.viewer.rollouts.scan import scans_of
from ce_gym.viewer.stream import Feed

POLICIES = ("policy.*", "checkpoints/policy_*")
"""Policies in the folder of a run."""


def newest_policy(run: Path) -> Path | None:
    """Return the newest policy of a run, or None."""
    files = [file for pattern in POLICIES for file in run.glob(pattern) if file.suffix in (".npz", ".zip")]
    files = [file for file in files if not file.name.startswith(".") and not file.stem.endswith(".learner")]
    return max(files, key=_modified, default=None)


def _modified(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # replaced or deleted in the meantime
        return 0.0


class Walker:
    """One robot that follows the commands and episodes of its task.

    Args:
        policy: The policy with its record.
        env_id: Environment from the command line; "" for the record's environment.
        kwargs: Arguments of the environment, in place of the record's.

    Attributes:
        policy: The acting policy; another policy of the same environment can replace it.
        dt: Length of a control step [s].
        scene: The scene of the robot.

    Raises:
        PolicyError: The environment must be named on the command line.
        ViewerError: The environment cannot be made, or is not of ce_gym.
    """

    def __init__(self, policy: Policy, env_id: str, kwargs: Mapping[str, Any]) -> None:
        env_id = environment_of(policy.record, env_id or None)
        options = {"command_curriculum": 1.0, **policy.record["env_kwargs"], **kwargs}
        self._env, native = make_envs(env_id, 1, options)
        self.policy, self._batch, self.dt = policy, native.batch, native.dt
        self._observation, _ = self._env.reset(seed=0)
        program = native.batch.program
        self._model = program.model
        ground, scan = field_of(program.task.terrain), scans_of(program)
        self.scene = MovingScene(self._model, self._model.standing_q, terrain=ground, scan=scan)

    def fits(self, policy: Policy) -> bool:
        """Return whether a policy acts in the same environment."""
        return all(policy.record[key] == self.policy.record[key] for key in ("env", "env_kwargs", "observation_size"))

    def step(self, feed: Feed, state: Mapping[str, Any]) -> bool:
        """Simulate one control step and publish it; return whether a browser is connected.

        Args:
            feed: Where to publish.
            state: Text for the page; command and velocity [m/s, rad/s] are added.
        """
        self._observation, *_ = self._env.step(self.policy.predict(self._observation)[0])
        q, v, command = (self._batch.rows(name)[0].astype(float) for name in ("q", "v", "command"))
        moves = v[[3, 4, 2]] if self._model.robot.floating else np.zeros(3)
        speeds = {"command": command.round(3).tolist(), "moves": moves.round(3).tolist()}
        return self.scene.send(feed, [self._model], [q], {**state, **speeds})

    def close(self) -> None:
        """Close the environment."""
        self._env.close()
