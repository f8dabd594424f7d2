"""The actuators of a compiled MJCF file -> torque limits and gains of joints.

The effort of an actuator on a joint is `gear * (gain * control + bias)`. An actuator with an affine bias is a position
controller with the robot's gains `kp` and `kd`; an actuator without bias is a motor. Several actuators on one joint add
up. By linear equalities, the coordinate of a joint or fixed tendon may be `ratio` times the coordinate of one
independent joint. Its actuator then acts on the independent joint, with `ratio` times the torque and `ratio^2` times
the gains. In a file with actuators, independent joints without actuator are passive: torque limit 0 and no gains.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from ce_gym.model.constraints import Constraint, LinearConstraint
from ce_gym.model.description import Gains
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.equalities import actuated_joints
from ce_gym.model.formats.mjcf.source import MjcfSource

Ratios = dict[str, tuple[str, float]]
"""For a body, the independent joint that moves it, and the body's coordinate per unit of that joint."""


def read_actuators(
    source: MjcfSource,
    tree: MjcfTree,
    independent: tuple[str, ...],
    constraints: Iterable[Constraint],
    driven: Collection[str] = (),
) -> Gains:
    """Set the torque limits of the tree's joints and return the gains; note other parts of actuators.

    Args:
        source: The compiled file.
        tree: The bodies of the file.
        independent: Bodies with independent joint coordinates.
        constraints: Constraints among the joints.
        driven: Bodies with rotors in the YAML file; they are not passive.
    """
    model, ratios = source.model, _ratios(independent, constraints)
    kp, kd = dict.fromkeys(independent, 0.0), dict.fromkeys(independent, 0.0)
    limits: dict[str, float] = {}
    moved = set(driven)
    for a in range(model.nu):
        moved |= {tree.moved_by[j] for j in actuated_joints(source, a) if j in tree.moved_by}
        body, ratio = _driven(source, tree, a, ratios)
        if body is None:
            continue
        moved.add(body)
        gear = abs(float(model.actuator_gear[a][0]) * ratio)
        limits[body] = limits.get(body, 0.0) + gear * _largest_force(source, a)
        if model.actuator_biastype[a] == source.mujoco.mjtBias.mjBIAS_AFFINE:
            kp[body] -= gear**2 * float(model.actuator_biasprm[a][1])
            kd[body] -= gear**2 * float(model.actuator_biasprm[a][2])
    for j, body in tree.moved_by.items():
        if model.jnt_actfrclimited[j]:
            limits[body] = min(limits.get(body, np.inf), float(np.abs(model.jnt_actfrcrange[j]).max()))
    for name in set(independent) - moved if model.nu else ():
        limits[name] = 0.0
        del kp[name], kd[name]
    tree.bodies[:] = [
        replace(body, joint=replace(body.joint, torque=limits[body.name])) if body.name in limits else body
        for body in tree.bodies
    ]
    return _gains(source, kp, kd)


def _ratios(independent: tuple[str, ...], constraints: Iterable[Constraint]) -> Ratios:
    """Return the ratios of independent joints, and of joints that linear constraints couple to one."""
    ratios: Ratios = {name: (name, 1.0) for name in independent}
    ties = [dict(tie.coefficients) for tie in constraints if isinstance(tie, LinearConstraint)]
    pairs = [tie for tie in ties if len(tie) == 2]
    while ties := [tie for tie in pairs if len(tie.keys() & ratios.keys()) == 1]:
        for tie in ties:
            for known, unknown in (tuple(tie), tuple(tie)[::-1]):
                if known in ratios and unknown not in ratios:
                    joint, ratio = ratios[known]
                    ratios[unknown] = joint, -ratio * tie[known] / tie[unknown]
    return ratios


def _gains(source: MjcfSource, kp: dict[str, float], kd: dict[str, float]) -> Gains:
    """Return gains for all joints if the file has a position controller."""
    if not any(kp.values()):
        if any(kd.values()):
            source.leave_out("velocity actuators (there is no position actuator)")
        return Gains()
    without = [joint for joint, gain in kp.items() if gain == 0.0]
    for joint in without:
        source.leave_out("a position gain for {} (no position actuator in the file; it is 0)", joint)
    return Gains(tuple(kp.items()), tuple(kd.items()))


def _driven(source: MjcfSource, tree: MjcfTree, a: int, ratios: Ratios) -> tuple[str | None, float]:
    """Return the independent joint that actuator `a` drives, and how far the actuator moves for a unit of that.

    None, with a note, if a robot cannot have such an actuator.
    """
    model, mujoco = source.model, source.mujoco
    name = source.name("actuator", a)
    joints = {tree.moved_by[j]: x for j, x in actuated_joints(source, a).items() if j in tree.moved_by and x}
    biases = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
    fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
    if not joints or not fixed or int(model.actuator_biastype[a]) not in biases:
        source.leave_out("actuator {} (not a motor or controller of one joint)", name)
        return None, 0.0
    if not joints.keys() <= ratios.keys():
        source.leave_out("actuator {} (its joint is not independent)", name)
        return None, 0.0
    ratio: dict[str, float] = {}
    for body, coefficient in joints.items():
        joint, per_joint = ratios[body]
        ratio[joint] = ratio.get(joint, 0.0) + coefficient * per_joint
    if len(ratio) > 1:
        source.leave_out("actuator {} (its tendon moves several independent joints)", name)
        return None, 0.0
    if model.actuator_dyntype[a] != mujoco.mjtDyn.mjDYN_NONE:
        source.leave_out("the activation dynamics of actuator {}", name)
    if np.any(getattr(model, "actuator_damping", np.zeros(model.nu))[a]):
        source.leave_out("the damping of actuator {}", name)
    return next(iter(ratio.items()))


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
