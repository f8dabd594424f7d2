# pyright: reportAttributeAccessIssue=false
"""A robot as a compiled MuJoCo model: its MJCF with published inertias, and how MuJoCo is to solve it.

(MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from ce_gym.export.mjcf import mass_properties, to_mjcf
from ce_gym.export.mjcf_mechanism import SMALLEST_INERTIA, mjcf_mechanism
from ce_gym.export.mjcf_text import quaternion
from ce_gym.model.description import Robot

STIFF = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of equalities held as stiffly as MuJoCo allows, with a time constant of two steps."""


@dataclass(frozen=True)
class Settings:
    """How MuJoCo is set up.

    Attributes:
        timestep: [s].
        integrator: Name in MJCF.
        solver: "Newton", "CG" or "PGS".
        iterations: Most iterations of the solver.
        line_search: Most iterations of its line search.
        solimp: Impedance of equalities, with the smallest time constant MuJoCo allows; None is its default for both.
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
    robot: Robot,
    transmission: str,
    *,
    timestep: float = 0.005,
    integrator: str = "implicitfast",
    solref: Sequence[float] | None = None,
    solimp: Sequence[float] | None = None,
    also: Callable[[mujoco.MjSpec], None] | None = None,
) -> mujoco.MjModel:
    """Compile a robot's MJCF and put back inertias that MuJoCo's compiler refuses; arguments as in `to_mjcf`.

    What `also` adds to the description is compiled with it.
    """
    text = to_mjcf(
        robot,
        transmission,
        timestep=timestep,
        integrator=integrator,
        ground=robot.floating,
        solref=solref,
        solimp=solimp,
    )
    spec = mujoco.MjSpec.from_string(text)
    if also:
        also(spec)
    model = spec.compile()
    for moving in mjcf_mechanism(robot, transmission).bodies.values():
        _, _, inertia = mass_properties(moving.inertia)
        moments, axes = np.linalg.eigh(inertia)
        axes *= np.sign(np.linalg.det(axes))
        model.body(moving.name).inertia[:] = np.maximum(moments, SMALLEST_INERTIA)
        model.body(moving.name).iquat[:] = quaternion(axes)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def compiled(
    robot: Robot, level: str, settings: Settings, also: Callable[[mujoco.MjSpec], None] | None = None
) -> mujoco.MjModel:
    """Compile a robot with settings, with what is added to it, and without whatever the scene does not need."""
    solref = None if settings.solimp is None else (2.0 * settings.timestep, 1.0)
    model = load(
        robot,
        level,
        timestep=settings.timestep,
        integrator=settings.integrator,
        solref=solref,
        solimp=settings.solimp,
        also=also,
    )
    model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{settings.solver.upper()}")
    model.opt.iterations, model.opt.ls_iterations = settings.iterations, settings.line_search
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model
