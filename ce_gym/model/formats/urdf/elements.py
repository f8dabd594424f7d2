"""Single URDF elements -> checked numbers, placements, inertials, joints and shapes.

Source: wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from ce_gym.model.description import Inertial, Joint, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.placement import exact_right_angles, rotation_from_rpy, symmetric, transform_inertial, vec3
from ce_gym.model.frames import Placement, Vec3, rotation_matrix

Color = tuple[float, float, float, float]

_INERTIA_ENTRIES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SIZES = {
    "box": [("size", 3)],
    "sphere": [("radius", 1)],
    "cylinder": [("radius", 1), ("length", 1)],
    "capsule": [("radius", 1), ("length", 1)],
}
_NO_LIMIT = float("inf")
_DEFAULT_COLOR = Shape.color


def numbers(file: str, where: str, element: Element, attribute: str, count: int) -> tuple[float, ...]:
    """Return the `count` finite numbers in an attribute that must be there."""
    text = element.get(attribute)
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    key = f"{where} <{element.tag} {attribute}>"
    if text is None:
        raise invalid_value(file, key, None, expected)
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        raise invalid_value(file, key, text, expected) from None
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise invalid_value(file, key, text, expected)
    return values


def number(file: str, where: str, element: Element | None, attribute: str, default: float) -> float:
    """Return one finite number, or `default` where the element or the attribute is missing."""
    if element is None or element.get(attribute) is None:
        return default
    return numbers(file, where, element, attribute, 1)[0]


def required(file: str, where: str, element: Element, tag: str) -> Element:
    """Return the child element called `tag`."""
    child = element.find(tag)
    if child is None:
        raise invalid_value(file, f"{where} <{tag}>", None, f"a <{tag}> element in <{element.tag}>")
    return child


def name_of(file: str, element: Element, attribute: str = "name", where: str = "") -> str:
    """Return a name that must be there and must not be empty."""
    name = element.get(attribute)
    if not name:
        raise invalid_value(file, f"{where} <{element.tag} {attribute}>".strip(), name, "a name")
    return name


def placement(file: str, where: str, parent: Element) -> Placement:
    """Return the pose in the <origin> of `parent`; the identity without <origin>."""
    return pose_of(file, where, parent.find("origin"))


def pose_of(file: str, where: str, origin: Element | None) -> Placement:
    """Return the pose of the attributes `xyz` and `rpy` of an element; the identity without element."""
    if origin is None:
        return Placement()
    xyz = numbers(file, where, origin, "xyz", 3) if origin.get("xyz") else (0.0, 0.0, 0.0)
    rpy = numbers(file, where, origin, "rpy", 3) if origin.get("rpy") else (0.0, 0.0, 0.0)
    return Placement(vec3(xyz), rotation_from_rpy(*rpy))


def inertial(file: str, where: str, link: Element) -> Inertial | None:
    """Return the mass properties of a link in the link's axes; None if it has none."""
    element = link.find("inertial")
    if element is None:
        return None
    mass = numbers(file, where, required(file, where, element, "mass"), "value", 1)[0]
    if mass < 0.0:
        raise invalid_value(file, f"{where} <mass value>", mass, "a mass that is not negative [kg]")
    matrix = required(file, where, element, "inertia")
    entries = [numbers(file, where, matrix, entry, 1)[0] for entry in _INERTIA_ENTRIES]
    about_com = Inertial(mass, (0.0, 0.0, 0.0), symmetric(*entries))
    return transform_inertial(placement(file, where, element), about_com)


def joint(file: str, where: str, element: Element, joint_type: str) -> Joint:
    """Return the joint model of a moving URDF joint; missing limits mean that there are none."""
    if joint_type == "floating":
        return Joint("free")
    limit, dynamics = element.find("limit"), element.find("dynamics")
    ends = (-_NO_LIMIT, _NO_LIMIT)
    if joint_type != "continuous":
        ends = number(file, where, limit, "lower", ends[0]), number(file, where, limit, "upper", ends[1])
    return Joint(
        type="prismatic" if joint_type == "prismatic" else "revolute",
        axis=axis(file, where, element),
        position=ends,
        torque=number(file, where, limit, "effort", _NO_LIMIT),
        velocity=number(file, where, limit, "velocity", _NO_LIMIT),
        damping=number(file, where, dynamics, "damping", 0.0),
        friction=number(file, where, dynamics, "friction", 0.0),
        stiffness=number(file, where, dynamics, "stiffness", 0.0),  # RaiSim's word for a spring at 0
    )


def unit_axis(file: str, key: str, axis: tuple[float, ...]) -> Vec3:
    """Return `axis` with length one; its sign is kept."""
    length = math.hypot(*axis)
    if length < 1e-9:
        raise invalid_value(file, key, axis, "an axis of length other than 0")
    return vec3([x / length + 0.0 for x in axis])


def axis(file: str, where: str, parent: Element) -> Vec3:
    """Return the unit vector in the <axis> of `parent`; x without <axis>."""
    element = parent.find("axis")
    if element is None:
        return (1.0, 0.0, 0.0)  # the format's default
    return unit_axis(file, f"{where} <axis xyz>", numbers(file, where, element, "xyz", 3))


def moved(file: str, where: str, element: Element, coordinate: float) -> Placement:
    """Return the pose of a joint's child in the joint's frame, at a coordinate [rad or m]."""
    if coordinate == 0.0:
        return Placement()
    along = np.array(axis(file, where, element))
    if element.get("type") == "prismatic":
        return Placement(vec3(coordinate * along))
    half = 0.5 * coordinate
    return Placement(rotation=exact_right_angles(rotation_matrix(np.array([np.cos(half), *np.sin(half) * along]))))


def shape(file: str, where: str, visual: Element, colors: dict[str, Color]) -> Shape | None:
    """Return a <visual> or <collision> as a primitive; None if it is a mesh, or a point (of a virtual link)."""
    geometry = required(file, where, visual, "geometry")
    pose = placement(file, where, visual)
    color = _color(file, where, visual.find("material"), colors)
    for kind in geometry:
        if kind.tag in _SIZES:
            size = tuple(value for name, count in _SIZES[kind.tag] for value in numbers(file, where, kind, name, count))
            if not any(size):
                return None
            if min(size) <= 0.0:
                raise invalid_value(file, f"{where} <{kind.tag}> size", size, "lengths above 0 [m]")
            return Shape(kind.tag, size, pose, color)  # type: ignore[arg-type]
    return None


def colors_of(file: str, robot: Element) -> dict[str, Color]:
    """Return the colours of all materials that have a name, wherever they are defined."""
    named = {}
    for material in robot.iter("material"):
        if material.get("name") and material.find("color") is not None:
            named[material.get("name")] = _color(file, f"material {material.get('name')!r}", material, {})
    return named


def _color(file: str, where: str, material: Element | None, colors: dict[str, Color]) -> Color:
    if material is None:
        return _DEFAULT_COLOR
    color = material.find("color")
    if color is None:
        return colors.get(material.get("name", ""), _DEFAULT_COLOR)
    red, green, blue, alpha = numbers(file, where, color, "rgba", 4)
    return (red, green, blue, alpha)
