"""The links, joints and belts of a robot as URDF for Drake.

Python's Drake has a coupler of two joints but no constraint of several, as a parallel belt is; its parsers do, as
`drake:tendon_constraint` (https://drake.mit.edu/doxygen_cxx/group__multibody__parsing.html). So the tree and its ties
go through URDF. Masses there are stand-ins: `plant.py` puts in the published inertias, which a parser would refuse
where they violate the triangle inequality.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix  # type: ignore[import-not-found]

from ce_gym.export.joint_ties import Tie
from ce_gym.export.mjcf_text import text
from ce_gym.model.mechanism import Mechanism, MovingBody

RIGID = 1e30
"""Stiffness of belts [N m/rad], infinite to the solver, which takes what its step allows; URDF has no infinity."""

JOINTS = {"revolute": "continuous", "prismatic": "prismatic"}
"""Types of joints in URDF."""


def to_urdf(mechanism: Mechanism, ties: Mapping[str, Tie]) -> str:
    """Return the URDF of a mechanism whose rotors, if it has any, are bodies; a joint is called after its body."""
    root = ET.Element("robot", name=mechanism.robot.name)
    for moving in mechanism.bodies.values():
        _add_body(root, moving)
    for name in mechanism.bodies:
        if name in ties and len(ties[name].ratios) > 1:
            _add_belt(root, name, ties[name])
    return ET.tostring(root, encoding="unicode")


def _add_body(root: ET.Element, moving: MovingBody) -> None:
    link = ET.SubElement(ET.SubElement(root, "link", name=moving.name), "inertial")
    ET.SubElement(link, "mass", value="1")
    ET.SubElement(link, "inertia", ixx="1", iyy="1", izz="1", ixy="0", ixz="0", iyz="0")
    if moving.joint.type == "free":
        return
    joint = ET.SubElement(root, "joint", name=moving.name, type=JOINTS[moving.joint.type])
    ET.SubElement(joint, "parent", link=moving.parent or "world")
    ET.SubElement(joint, "child", link=moving.name)
    angles = RollPitchYaw(RotationMatrix(np.asarray(moving.rotation, dtype=float))).vector()
    ET.SubElement(joint, "origin", xyz=text(moving.position), rpy=text(angles))
    ET.SubElement(joint, "axis", xyz=text(moving.axis))
    ET.SubElement(joint, "dynamics", damping=text(moving.joint.damping))


def _add_belt(root: ET.Element, name: str, tie: Tie) -> None:
    """Tie a joint to several others: a tendon that can neither grow nor shrink, as stiff as the solver has it."""
    tendon = ET.SubElement(root, "drake:tendon_constraint")
    for joint, ratio in {name: 1.0, **{joint: -ratio for joint, ratio in tie.ratios.items()}}.items():
        ET.SubElement(tendon, "drake:tendon_constraint_joint", name=joint, a=text(ratio))
    figures = {"offset": -tie.offset, "lower_limit": 0.0, "upper_limit": 0.0, "stiffness": RIGID, "damping": 0.0}
    for key, value in figures.items():
        ET.SubElement(tendon, f"drake:tendon_constraint_{key}", value=str(value))
