# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""A robot as a compiled MuJoCo model, with published inertias and settings of the solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from ce_gym.export.mjcf import mass_properties, to_mjcf
from ce_gym.export.mjcf_mechanism import SMALLEST_INERTIA, mjcf_mechanism
from ce_gym.export.mjcf_text import quaternion
from ce_gym.model.description import Robot

STIFF = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of the stiffest equalities that MuJoCo allows, with a time constant of two steps."""


@dataclass(frozen=True)
class Settings:
    """Options of MuJoCo.

    Attributes:
        timestep: Step [s].
        integrator: Name in MJCF.
        solver: "Newton", "CG" or "PGS".
        iterations: Maximum number of iterations of the solver.
        line_search: Maximum number of iterations of its line search.
        solimp: Impedance of equalities, with the smallest time constant MuJoCo allows; by default MuJoCo's defaults.
    """

    timestep: float
    integrator: str = "implicitfast"
    solver: str = "Newton"
    iterations: int = 100
    line_search: int = 50
    solimp: tuple[float, ...] | None = None

    def __str__(self) -> str:
        gears = "" if self.solimp is None else ", stiff equalities"
        return f"{self.integrator}, {self.solver} {self.iterations}/{self.line_search}{gears}"


def load(
    robot: Robot, transmission: str, extend: Callable[[mujoco.MjSpec], None] | None = None, **options: Any
) -> mujoco.MjModel:
    """Compile the MJCF of a robot and put back inertias that MuJoCo's compiler refuses.

    Args:
        robot: The robot.
        transmission: Transmission level.
        extend: Adds elements to the description before compilation.
        **options: Options of `to_mjcf`.
    """
    text = to_mjcf(robot, transmission, ground=robot.floating, **options)
    spec = mujoco.MjSpec.from_string(text)
    if extend:
        extend(spec)
    model = spec.compile()
    for moving in mjcf_mechanism(robot, transmission).bodies.values():
        _, _, inertia = mass_properties(moving.inertia)
        moments, axes = np.linalg.eigh(inertia)
        axes *= np.sign(np.linalg.det(axes))
        model.body(moving.name).inertia[:] = np.maximum(moments, SMALLEST_INERTIA)
        model.body(moving.name).iquat[:] = quaternion(axes)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def compile_model(
    robot: Robot, level: str, settings: Settings, extend: Callable[[mujoco.MjSpec], None] | None = None
) -> mujoco.MjModel:
    """Compile a robot with settings, without MuJoCo's islands; `extend` as in `load`."""
    solref = None if settings.solimp is None else (2.0 * settings.timestep, 1.0)
    options = {"timestep": settings.timestep, "integrator": settings.integrator}
    model = load(robot, level, extend, solref=solref, solimp=settings.solimp, **options)
    model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{settings.solver.upper()}")
    model.opt.iterations, model.opt.ls_iterations = settings.iterations, settings.line_search
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model
