"""Notes on attributes of a compiled MJCF file that no part of the reader reads.

Each note names the attribute if its name in MJCF differs from the usual word.
Source: https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.formats.mjcf.equalities import actuated_joints, coupling_tendons
from ce_gym.model.formats.mjcf.source import MjcfSource
from ce_gym.model.formats.mjcf.touching import is_default_solver, solid


def report_unmodelled(source: MjcfSource) -> None:
    """Note all attributes that act on the robot in MuJoCo and that no part of the reader reads."""
    _report_world(source)
    _report_joints(source)
    _report_actuators(source)
    for g in range(source.model.ngeom):
        if solid(source, g):
            for attribute, what in (("adhesion", "adhesion"), ("surfacevel", "moving surface (surfacevel)")):
                if np.any(_new(source, f"geom_{attribute}", source.model.ngeom)[g]):
                    source.leave_out(f"{what} of geom {{}}", source.name("geom", g))


def _new(source: MjcfSource, attribute: str, count: int) -> NDArray[np.float64]:
    """Return an attribute of later versions of MuJoCo, zeros in earlier versions, shape (count, ...)."""
    return np.asarray(getattr(source.model, attribute, np.zeros(count)))


def _report_joints(source: MjcfSource) -> None:
    model, free = source.model, source.mujoco.mjtJoint.mjJNT_FREE
    for j in range(model.njnt):
        dof, name = int(model.jnt_dofadr[j]), source.name("joint", j)
        if model.jnt_type[j] == free and np.any(model.dof_damping[dof : dof + 6]):
            source.leave_out("damping of the free joint {}", name)
        if model.jnt_stiffness[j] and np.any(_new(source, "jnt_springyield", model.njnt)[j]):
            source.leave_out("yielding (springyield) of the spring of joint {}", name)
        if model.jnt_limited[j] and model.jnt_margin[j]:
            source.leave_out("margin of the limit of joint {}", name)
        if model.jnt_limited[j] and not is_default_solver((*model.jnt_solref[j], *model.jnt_solimp[j])):
            source.leave_out("compliance (solreflimit, solimplimit) of the limit of joint {}", name)
        if model.dof_frictionloss[dof] and not is_default_solver((*model.dof_solref[dof], *model.dof_solimp[dof])):
            source.leave_out("compliance (solreffriction, solimpfriction) of the dry friction of joint {}", name)


def _report_actuators(source: MjcfSource) -> None:
    model, affine = source.model, source.mujoco.mjtBias.mjBIAS_AFFINE
    if not source.enabled("ACTUATION"):
        source.leave_out('the <flag actuation="disable"/>')
    clamped = model.actuator_ctrllimited & source.enabled("CLAMPCTRL")
    for a in range(model.nu):
        name = source.name("actuator", a)
        if model.opt.disableactuator & 1 << int(model.actuator_group[a]) and 0 <= model.actuator_group[a] < 31:
            source.leave_out("the actuatorgroupdisable of actuator {}", name)
        joints = actuated_joints(source, a)
        if len(joints) != 1 or model.actuator_gaintype[a] != source.mujoco.mjtGain.mjGAIN_FIXED:
            continue  # left out as a whole
        if np.any(_new(source, "actuator_delay", model.nu)[a]):
            source.leave_out("delay of actuator {}", name)
        if model.actuator_biastype[a] == affine and model.actuator_biasprm[a][0]:
            source.leave_out("constant force (first of biasprm) of actuator {}", name)
        if model.actuator_forcelimited[a] and _is_lopsided(model.actuator_forcerange[a]):
            source.leave_out("the nearer one of the two limits forcerange of actuator {}", name)
        if model.actuator_biastype[a] != affine and clamped[a]:
            if _is_lopsided(model.actuator_ctrlrange[a]):
                source.leave_out("the nearer one of the two limits ctrlrange of actuator {}", name)
        elif clamped[a] and _narrows(source, a, *joints):
            source.leave_out("ctrlrange of actuator {}, narrower than the range of its joint", name)
    for j in range(model.njnt):
        if model.jnt_actfrclimited[j] and _is_lopsided(model.jnt_actfrcrange[j]):
            source.leave_out("the nearer one of the two limits actuatorfrcrange of joint {}", source.name("joint", j))


def _is_lopsided(limits: NDArray[np.float64]) -> bool:
    return not np.isclose(-limits[0], limits[1], rtol=1e-6)


def _narrows(source: MjcfSource, a: int, joint: int) -> bool:
    """Whether a position actuator's targets are limited to less than the range of its joint."""
    model, gear = source.model, float(source.model.actuator_gear[a][0])
    stiffness = -float(model.actuator_biasprm[a][1])
    if gear == 0.0 or stiffness == 0.0:
        return False
    low, high = sorted(model.actuator_ctrlrange[a] * (float(model.actuator_gainprm[a][0]) / stiffness / gear))
    if not model.jnt_limited[joint]:
        return True
    slack = 1e-3 * float(np.ptp(model.jnt_range[joint]))  # files are rounded
    return bool(low > model.jnt_range[joint][0] + slack or high < model.jnt_range[joint][1] - slack)


def _report_world(source: MjcfSource) -> None:
    """Note what acts on the whole robot."""
    model = source.model
    for what, value in (("wind", model.opt.wind), ("density", model.opt.density), ("viscosity", model.opt.viscosity)):
        if np.any(value):
            source.leave_out("{} of the medium", what)
    if model.nkey and np.any(model.key_qvel[0]):
        source.leave_out("the velocity (qvel) of the reference pose")
    for count, what in ((model.nflex, "deformable bodies"), (model.nplugin, "plugins")):
        if count:
            source.leave_out(what)
    couplings = coupling_tendons(source)
    for t in range(model.ntendon):
        for key in ("stiffness", "damping", "frictionloss", "limited"):
            if np.any(getattr(model, f"tendon_{key}")[t]) and not (key == "limited" and t in couplings):
                source.leave_out(f"{'range' if key == 'limited' else key} of tendon {{}}", source.name("tendon", t))
