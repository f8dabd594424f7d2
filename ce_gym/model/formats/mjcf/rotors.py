"""The armature of a compiled MJCF file -> rotors behind gears.

Armature is the reflected inertia `ratio^2 J` of a rotor. MuJoCo adds armature to the diagonal of the mass matrix, and
neglects the coupling of a spinning rotor to its carrier (terms `ratio J`) and the gyroscopic torque. Here every
armature becomes a rotor, a thin disc about the joint axis at the joint, behind a gear:

- `coupled` reproduces MuJoCo's mass matrix, and `armature` too unless tendon armature or an equality ties several
  joints together; `none` lacks the armature;
- `exact` adds the neglected terms if the ratio is known: the `gear` of the joint's actuator, if it is not 1, or the
  caller's ratio. An unknown ratio is taken as 1e6, a limit in which only armature remains and `exact` equals MuJoCo
  too. The warning lists unknown ratios.

The rotors are thin discs without mass, see `rotor_links.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import UNKNOWN_RATIO, Body, Joint
from ce_gym.model.formats.mjcf.bodies import MjcfTree
from ce_gym.model.formats.mjcf.equalities import actuated_joints, tendon_coefficients
from ce_gym.model.formats.mjcf.source import MjcfSource
from ce_gym.model.formats.rotor_links import disc, without_rotors
from ce_gym.model.frames import Placement


@dataclass(frozen=True)
class _Armature:
    """Reflected inertia of a rotor that turns with `sum(coefficient * joint coordinate)`.

    Attributes:
        name: Name of the joint's body, of the tendon or of the actuator.
        joints: Coefficients of joint coordinates, by joint index.
        reflected: Reflected inertia `ratio^2 J` [kg m^2 or kg].
        ratio: Speed of the rotor over the speed of the sum; None if unknown.
    """

    name: str
    joints: dict[int, float]
    reflected: float
    ratio: float | None


def add_rotors(
    source: MjcfSource, tree: MjcfTree, gear_ratios: Mapping[str, float], driven: Collection[str]
) -> tuple[LinearConstraint, ...]:
    """Add a rotor to the tree for each armature, and return the gears.

    Args:
        source: The compiled file.
        tree: The bodies of the file; gains the rotors.
        gear_ratios: Ratios that are not in the file, by the name of the body that the joint moves.
        driven: Bodies with rotors in the YAML file; the armature of their joints is ignored.
    """
    ratios = _known_ratios(source, tree) | {j: gear_ratios[b] for j, b in tree.moved_by.items() if b in gear_ratios}
    armatures = [*_joint_armatures(source, tree, ratios), *_tendon_armatures(source), *_motor_armatures(source)]
    moving = [replace(a, joints={j: x for j, x in a.joints.items() if j in tree.moved_by}) for a in armatures]
    moving = [a for a in moving if not {tree.moved_by[j] for j in a.joints} & set(driven)]
    for armature in moving:
        if armature.joints and armature.ratio is None:
            source.leave_out(
                "the gear ratio behind the armature of {} (`exact` keeps an armature there)", armature.name
            )
    by_carrier: dict[str | None, list[_Armature]] = {}
    for armature in moving:
        if armature.joints:
            by_carrier.setdefault(_carrier(tree, armature), []).append(armature)
    return tuple(gear for carrier, armatures in by_carrier.items() for gear in _mount(source, tree, carrier, armatures))


def _mount(
    source: MjcfSource, tree: MjcfTree, carrier: str | None, armatures: list[_Armature]
) -> Iterator[LinearConstraint]:
    """Mount rotors on a body, subtract their inertia at rest from the body, and iterate over their gears."""
    known = [armature for armature in armatures if armature.ratio is not None]
    if known and not _take_out(tree, carrier, [_rotor(tree, carrier, armature) for armature in known]):
        names = ", ".join(armature.name for armature in known)
        source.leave_out("the gear ratio at {}", f"{names} (such rotors have more inertia than {carrier})")
        armatures = [replace(armature, ratio=None) for armature in armatures]
    for armature in armatures:
        rotor = _rotor(tree, carrier, armature)
        tree.bodies.append(rotor)
        ratio = _ratio(armature)
        pairs = tuple((tree.moved_by[j], -ratio * x) for j, x in armature.joints.items())
        yield LinearConstraint(rotor.name, ((rotor.name, 1.0), *pairs))


def _take_out(tree: MjcfTree, carrier: str | None, rotors: list[Body]) -> bool:
    """Subtract the rotors' inertia at rest from their carrier; return whether the carrier has enough inertia."""
    if carrier is None:
        return True
    at = next(i for i, body in enumerate(tree.bodies) if body.name == carrier)
    rest = without_rotors(tree.bodies[at].inertial, rotors)
    if rest is None:
        return False
    tree.bodies[at] = replace(tree.bodies[at], inertial=rest)
    return True


def _carrier(tree: MjcfTree, armature: _Armature) -> str | None:
    """Return the nearest common ancestor of all joints of an armature."""
    parents = {body.name: body.parent for body in tree.bodies}
    chains: list[list[str | None]] = []
    for j in armature.joints:
        chain: list[str | None] = [parents[tree.moved_by[j]]]
        while chain[-1] is not None:
            chain.append(parents[chain[-1]])
        chains.append(chain)
    return next(body for body in chains[0] if all(body in chain for chain in chains))


def _rotor(tree: MjcfTree, carrier: str | None, armature: _Armature) -> Body:
    """Return a rotor on `carrier`: a thin disc without mass, about the joint's axis if one joint drives it."""
    driven = next(body for body in tree.bodies if body.name == tree.moved_by[min(armature.joints)])
    moment = armature.reflected / _ratio(armature) ** 2
    place = driven.placement if driven.parent == carrier else Placement()
    name = tree.fresh(f"{armature.name}_rotor")
    return Body(name, "rotor", carrier, place, Joint("revolute", driven.joint.axis), disc(moment, driven.joint.axis))


def _ratio(armature: _Armature) -> float:
    return UNKNOWN_RATIO if armature.ratio is None else armature.ratio


def _known_ratios(source: MjcfSource, tree: MjcfTree) -> dict[int, float]:
    """Return gear ratios by joint index: the gear of a joint's only actuator, if it is not 1."""
    model = source.model
    gears: dict[int, list[float]] = {}
    for a in range(model.nu):
        joints = actuated_joints(source, a)
        for joint, coefficient in joints.items() if len(joints) == 1 else ():
            gears.setdefault(joint, []).append(float(model.actuator_gear[a][0]) * coefficient)
    return {j: gear[0] for j, gear in gears.items() if len(gear) == 1 and abs(gear[0]) not in (0.0, 1.0)}


def _joint_armatures(source: MjcfSource, tree: MjcfTree, ratios: Mapping[int, float]) -> list[_Armature]:
    model = source.model
    armatures = []
    kinds, joints = source.mujoco.mjtJoint, tree.moved_by | dict.fromkeys(tree.hinged, "")
    for j, body in joints.items():
        reflected = float(model.dof_armature[model.jnt_dofadr[j]])
        kind = {int(kinds.mjJNT_FREE): "free", int(kinds.mjJNT_BALL): "ball"}.get(int(model.jnt_type[j]))
        if kind is not None:
            if reflected:
                source.leave_out(f"armature of the {kind} joint {{}}", source.name("joint", j))
        elif reflected:
            armatures.append(_Armature(body, {j: 1.0}, reflected, ratios.get(j)))
    return armatures


def _tendon_armatures(source: MjcfSource) -> list[_Armature]:
    model = source.model
    armatures = []
    for t in range(model.ntendon):
        name, reflected = source.name("tendon", t), float(getattr(model, "tendon_armature", np.zeros(model.ntendon))[t])
        coefficients = tendon_coefficients(source, t)
        if reflected and coefficients is None:
            source.leave_out("armature of the spatial tendon {}", name)
        elif reflected:
            armatures.append(_Armature(name, coefficients or {}, reflected, None))
    return armatures


def _motor_armatures(source: MjcfSource) -> list[_Armature]:
    """Return armatures of actuators, at the motor side of the gear; in MuJoCo since 4.0."""
    model = source.model
    armatures = []
    for a in range(model.nu):
        inertia = float(getattr(model, "actuator_armature", np.zeros(model.nu))[a])
        gear, name = float(model.actuator_gear[a][0]), source.name("actuator", a)
        joints = actuated_joints(source, a)
        if inertia and not joints:
            source.leave_out("armature of actuator {}", name)
        elif inertia:
            armatures.append(_Armature(name, joints, inertia * gear**2, None if abs(gear) in (0.0, 1.0) else gear))
    return armatures
