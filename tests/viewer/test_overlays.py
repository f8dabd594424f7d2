"""Overlays of robots: they lie where the robot's description says, and have the inertia of their links."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hopper import make_robot

from ce_gym.model import load_robot
from ce_gym.model.description import Capsule, ContactSphere, Frame, Inertial, Shape
from ce_gym.model.frames import Placement
from ce_gym.viewer.page.fallback_shapes import rotor_discs
from ce_gym.viewer.page.overlays import (
    collision_shapes,
    contact_shapes,
    frame_shapes,
    inertia_boxes,
    overlay_commands,
)


def inertia_of(box: Shape, mass: float) -> np.ndarray:
    """Return the inertia of a homogeneous box about its centre, in the axes of the body."""
    rotation, squares = np.array(box.placement.rotation), np.square(box.size)
    assert np.linalg.det(rotation) == pytest.approx(1)
    return rotation @ np.diag(mass / 12 * (squares.sum() - squares)) @ rotation.T


@pytest.mark.parametrize("name", ["cassie", "tello", "g1"])
def test_boxes_have_the_inertia_of_their_links(name: str) -> None:
    robot = load_robot(name)
    boxes = inertia_boxes(robot)
    assert boxes.keys() == {body.name for body in robot.bodies if body.kind == "link" and body.inertial.mass}
    wrong = []
    for link, (box,) in boxes.items():
        inertial = robot.body(str(link)).inertial
        assert box.placement.position == pytest.approx(inertial.com)
        moments = np.linalg.eigvalsh(np.array(inertial.inertia))
        is_solid = moments[2] < moments[:2].sum() - 1e-8 * inertial.mass / 6
        error = inertia_of(box, inertial.mass) - inertial.inertia
        wrong += [link] if is_solid and np.abs(error).max() > 1e-9 * moments[2] else []
    assert wrong == []


def test_an_impossible_inertia_gives_a_flat_box() -> None:
    robot = make_robot()
    flat = Inertial(2.0, (0.0, 0.0, 0.0), ((0.01, 0, 0), (0, 0.02, 0), (0, 0, 0.05)))
    (box,) = inertia_boxes(replace(robot, bodies=(replace(robot.bodies[0], inertial=flat),)))["base"]
    assert min(box.size) == pytest.approx(1e-4)


def test_contacts_are_balls_and_discs_of_their_size() -> None:
    wheel = ContactSphere("wheel", "base", (0.1, 0.0, -0.1), 0.01, rim=0.06, axis=(0.0, 1.0, 0.0))
    point = ContactSphere("point", "base", (0.0, 0.0, -0.2), 0.0)
    robot = make_robot()
    shapes = contact_shapes(replace(robot, contacts=(*robot.contacts, wheel, point)))
    (foot,), (disc, small) = shapes["leg/1"], shapes["base"]
    assert (foot.size, foot.placement.position) == ((0.02,), (0.0, 0.0, -0.25))
    assert disc.size[0] == pytest.approx(0.07)
    np.testing.assert_allclose(np.array(disc.placement.rotation)[:, 2], wheel.axis)
    assert 0 < small.size[0] < 0.02  # a point is visible, and smaller than a foot


def test_axes_lie_along_the_frame() -> None:
    quarter = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    robot = replace(make_robot(), frames=(Frame("tool", "leg/1", Placement((0.1, 0.2, 0.3), quarter)),))
    *_, x, y, z = frame_shapes(robot)["leg/1"]
    for axis, shape in zip(np.array(quarter).T, (x, y, z), strict=True):
        along = np.array(shape.placement.rotation)[:, 0]
        np.testing.assert_allclose(along, axis, atol=1e-12)
        np.testing.assert_allclose(shape.placement.position, [0.1, 0.2, 0.3] + along * shape.size[0] / 2, atol=1e-12)
    assert "rotor" not in frame_shapes(robot)


def test_collision_shapes_are_the_capsules_of_the_simulation() -> None:
    robot = replace(make_robot(), capsules=(Capsule("leg/1", (0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 0.05),))
    (capsule,) = collision_shapes(robot)["leg/1"]
    assert capsule.size == pytest.approx((0.05, 0.3))
    np.testing.assert_allclose(capsule.placement.position, [0.15, 0, 0])
    np.testing.assert_allclose(np.array(capsule.placement.rotation)[:, 2], [1, 0, 0])


def test_every_overlay_is_hidden_at_first_and_named_after_its_kind() -> None:
    robot = make_robot()
    commands = list(overlay_commands(robot, "/world/0"))
    drawn = {c["path"].rpartition("/")[0] for c in commands if c["type"] == "set_object"}
    hidden = {c["path"] for c in commands if c["type"] == "set_property" and c["value"] is False}
    assert drawn == hidden
    kinds = {path.rpartition("_")[2] for path in drawn}
    assert kinds == {"contacts", "frames", "inertia", "collision", "center"}
    assert "/world/0/base/leg_1/overlay_contacts" in drawn


def test_rotors_have_a_sensible_size() -> None:
    """Rotors of mass zero or without inertia, too."""
    for name in ("cassie", "g1", "mit_humanoid", "mini_cheetah", "dr_legs"):
        discs = rotor_discs(load_robot(name))
        assert discs.keys() == {rotor.name for rotor in load_robot(name).rotors()}
        assert all(0.004 < disc.size[0] < 0.08 for disc in discs.values()), name
    robot = make_robot(rotor_shape=False)
    (disc,) = rotor_discs(robot).values()
    radius, height = disc.size
    assert 1000 * np.pi * radius**4 * height / 2 == pytest.approx(0.01)  # kg m^2 about y
    np.testing.assert_allclose(np.array(disc.placement.rotation)[:, 2], [0, 1, 0])
    *links, rotor = robot.bodies
    unknown = replace(
        rotor, inertial=Inertial(0.0, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    )
    (disc,) = rotor_discs(replace(robot, bodies=(*links, unknown))).values()
    assert disc.size[0] == pytest.approx(0.03 * 0.25)
