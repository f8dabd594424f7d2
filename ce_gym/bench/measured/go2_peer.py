# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""Windows of a log of joints in MuJoCo, for the same optimiser as ce_gym's."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.export.mujoco_coordinates import joint_rows
from ce_gym.export.mujoco_model import load
from ce_gym.identify.log import Log
from ce_gym.identify.parameters import Parameter
from ce_gym.identify.shooting import Shooting

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class PeerShooting(Shooting):
    """Simulates windows in MuJoCo with armature, `damping` and `frictionloss` of joints, and delay.

    Each motor is geared to one joint. A gear of ratio n gives the joint n^2 times the rotor's inertia and damping, and
    n times its dry friction.
    """

    def __init__(self, model: Model, log: Log, parameters: Sequence[Parameter], substep: float, **options: Any) -> None:
        super().__init__(model, log, parameters, substep, **options)
        self._mujoco = load(model.robot, "armature", timestep=log.dt / self.substeps)
        rows = joint_rows(self._mujoco)
        self._qpos, self._qvel = np.array([rows[name] for name in model.joint_links]).T
        names = [model.robot.joint_name(name) for name in model.joint_links]
        self._actuators = [self._mujoco.actuator(name).id for name in names]
        G = model.explicit_constraint(model.standing_q, np.zeros(model.nv))[0]
        self._gears = {}
        for rotor in model.robot.rotors():
            ratios = G[model.robot.spanning_rows[rotor.name][1].start]
            joint = int(np.abs(ratios).argmax())
            self._gears[rotor.name] = (int(self._qvel[joint]), float(ratios[joint]))

    def _candidate(self, values: Array) -> mujoco.MjModel:
        """Return the model at parameters (P,)."""
        model = copy.copy(self._mujoco)
        for parameter, value in zip(self.parameters, values, strict=True):
            row, ratio = self._gears.get(parameter.element, (0, 0.0))
            if parameter.kind == "rotor_inertia":
                model.dof_armature[row] *= value
            elif parameter.kind == "motor_damping":
                model.dof_damping[row] = value * ratio**2
            elif parameter.kind == "motor_friction":
                model.dof_frictionloss[row] = value * abs(ratio)
        return model

    def _batch(self, values: Array, states: Array, first: Indices, length: int) -> tuple[Array, Array]:
        C, W, nq = len(values), len(first), self.model.nq
        models = [model for candidate in values for model in [self._candidate(candidate)] * W]
        flat = states.reshape(C * W, -1)
        start = np.zeros((C * W, 1 + self._mujoco.nq + self._mujoco.nv))
        start[:, 1 + self._qpos] = flat[:, :nq]
        start[:, 1 + self._mujoco.nq + self._qvel] = flat[:, nq:]
        rows = self.starts(values, first)[:, None] + np.arange((length - 1) * self.substeps + 1) / self.substeps
        targets = np.diff(self.integral(rows), axis=1) * self.substeps
        control = np.empty_like(targets)
        control[..., self._actuators] = targets
        datas = [mujoco.MjData(self._mujoco) for _ in range(usable_cores())]
        after = np.asarray(rollout.rollout(models, datas, start, control)[0])
        after = np.concatenate([start[:, None], after[:, self.substeps - 1 :: self.substeps]], axis=1)
        q, v = after[..., 1 + self._qpos], after[..., 1 + self._mujoco.nq + self._qvel]
        last = np.hstack([q[:, -1], v[:, -1]]).reshape(C, W, -1)
        return self.encoders(q, v).reshape(C, W, length, -1), last
