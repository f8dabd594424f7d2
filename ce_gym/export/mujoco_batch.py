# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""Copies of a MuJoCo model that are rolled out together."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

Array = NDArray[np.float64]
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass
class Batch:
    """Copies of a robot that `mujoco.rollout` steps, one after another on each thread.

    Attributes:
        model: Compiled model.
        num_envs: Number of copies.
        num_threads: Number of threads; 1 uses the calling thread.
        states: Full physics states, shape (num_envs, n_state).
    """

    model: mujoco.MjModel
    num_envs: int
    num_threads: int = 1
    states: Array = field(init=False)

    def __post_init__(self) -> None:
        workers = self.num_threads if self.num_threads > 1 else 0
        self.datas = [mujoco.MjData(self.model) for _ in range(self.num_threads)]
        self.data = self.datas[0]
        self.pool = rollout.Rollout(nthread=workers)
        self.reset()

    def reset(self) -> None:
        """Put every copy into the standing keyframe."""
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self.states = np.tile(state, (self.num_envs, 1))
        self.data.warning.number[:] = 0

    def trajectory(self, control: Array, out: Array | None = None) -> Array:
        """Roll out from the current states, without changing them.

        Args:
            control: Position targets of the actuators [rad] at every step, shape (num_envs, n_steps, nu).
            out: Array for the result; None allocates one.

        Returns:
            States after every step, shape (num_envs, n_steps, n_state).
        """
        n_steps = control.shape[1]
        states, _ = self.pool.rollout(self.model, self.datas, self.states, control, nstep=n_steps, state=out)
        return np.asarray(states)

    def split(self, states: Array) -> tuple[Array, Array]:
        """Return MuJoCo's positions (..., nq) and velocities (..., nv) of full physics states."""
        nq, nv = self.model.nq, self.model.nv
        return states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + nv]

    def contacts(self) -> float:
        """Return the mean number of contacts of the current states."""
        counts = []
        for state in self.states:
            mujoco.mj_setState(self.model, self.data, state, STATE)
            mujoco.mj_forward(self.model, self.data)
            counts.append(self.data.ncon)
        return float(np.mean(counts))

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo met a bad state since the last reset (MuJoCo then resets that copy silently)."""
        bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        return any(self.data.warning[int(kind)].number > 0 for kind in bad)
