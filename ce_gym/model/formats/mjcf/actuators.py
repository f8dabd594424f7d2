"""The actuators of a compiled MJCF file -> torque limits and gains of joints.

An actuator on a joint gives `gear * (gain * control + bias)`. With an affine bias it is a position controller, whose
gains are the robot's `kp` and `kd`; without one it is a motor. Several on one joint add up. Where a file has actuators,
a joint that has a spring and none of them is passive: its torque limit is 0, and it has no gains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ce_gym.model.description import Gains
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.equalities import drives_joint
from ce_gym.model.formats.mjcf.source import MjcfSource


def read_actuators(source: MjcfSource, tree: MjcfTree, independent: tuple[str, ...]) -> Gains:
    """Set the torque limits of the tree's joints and return the gains; what else there is is left out."""
    model = source.model
    kp, kd = dict.fromkeys(independent, 0.0), dict.fromkeys(independent, 0.0)
    limits: dict[str, float] = {}
    for a in range(model.nu):
        body = _driven(source, tree, a, independent)
        if body is None:
            continue
        gear = abs(float(model.actuator_gear[a][0]))
        limits[body] = limits.get(body, 0.0) + gear * _largest_force(source, a)
        if model.actuator_biastype[a] == source.mujoco.mjtBias.mjBIAS_AFFINE:
            kp[body] -= gear**2 * float(model.actuator_biasprm[a][1])
            kd[body] -= gear**2 * float(model.actuator_biasprm[a][2])
    for j, body in tree.moved_by.items():
        if model.jnt_actfrclimited[j]:
            limits[body] = min(limits.get(body, np.inf), float(np.abs(model.jnt_actfrcrange[j]).max()))
    springs = {body.name for body in tree.bodies if body.joint.stiffness}
    passive = springs.intersection(independent) - _moved(source, tree) if model.nu else ()
    for name in passive:
        limits[name] = 0.0
        del kp[name], kd[name]
    tree.bodies[:] = [
        replace(body, joint=replace(body.joint, torque=limits[body.name])) if body.name in limits else body
        for body in tree.bodies
    ]
    return _gains(source, kp, kd)


def _moved(source: MjcfSource, tree: MjcfTree) -> set[str]:
    """Return the joints that an actuator of the file moves, those included whose actuator is left out."""
    model, mujoco = source.model, source.mujoco
    moved: set[int] = set()
    for a, (first, _) in enumerate(model.actuator_trnid):
        if drives_joint(source, a):
            moved.add(int(first))
        elif model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON:
            along = range(model.tendon_adr[first], model.tendon_adr[first] + model.tendon_num[first])
            moved |= {int(model.wrap_objid[w]) for w in along if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}
    return {tree.moved_by[j] for j in moved if j in tree.moved_by}


def _gains(source: MjcfSource, kp: dict[str, float], kd: dict[str, float]) -> Gains:
    """Return gains for all joints if there is a position controller at all."""
    if not any(kp.values()):
        if any(kd.values()):
            source.leave_out("velocity actuators (there is no position actuator)")
        return Gains()
    without = [joint for joint, gain in kp.items() if gain == 0.0]
    for joint in without:
        source.leave_out("a position gain for {} (no position actuator in the file; it is 0)", joint)
    return Gains(tuple(kp.items()), tuple(kd.items()))


def _driven(source: MjcfSource, tree: MjcfTree, a: int, independent: tuple[str, ...]) -> str | None:
    """Return the body whose joint actuator `a` drives; None, with a note, if a robot cannot have such an actuator."""
    model, mujoco = source.model, source.mujoco
    name = source.name("actuator", a)
    body = tree.moved_by.get(int(model.actuator_trnid[a][0])) if drives_joint(source, a) else None
    biases = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
    fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
    if body is None or not fixed or int(model.actuator_biastype[a]) not in biases:
        source.leave_out("actuator {} (not a motor or controller of one joint)", name)
        return None
    if body not in independent:
        source.leave_out("actuator {} (its joint is not independent)", name)
        return None
    if model.actuator_dyntype[a] != mujoco.mjtDyn.mjDYN_NONE:
        source.leave_out("the activation dynamics of actuator {}", name)
    if np.any(getattr(model, "actuator_damping", np.zeros(model.nu))[a]):
        source.leave_out("the damping of actuator {}", name)
    return body


def _largest_force(source: MjcfSource, a: int) -> float:
    """Return the largest force of an actuator before its gear [N m or N]; infinite if the file does not limit it."""
    model = source.model
    largest = np.inf
    if model.actuator_forcelimited[a]:
        largest = float(np.abs(model.actuator_forcerange[a]).max())
    motor = model.actuator_biastype[a] == source.mujoco.mjtBias.mjBIAS_NONE
    if motor and model.actuator_ctrllimited[a] and source.enabled("CLAMPCTRL"):
        gain = abs(float(model.actuator_gainprm[a][0]))
        largest = min(largest, gain * float(np.abs(model.actuator_ctrlrange[a]).max()))
    return largest
