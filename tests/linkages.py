"""Small mechanisms with closed loops for the tests."""

from __future__ import annotations

from ce_gym.model import Body, Inertial, Joint, LinearConstraint, LoopConstraint, Placement, Pose, Robot, RodConstraint


def link(name: str, parent: str | None, position: tuple, axis: tuple = (0.0, 0.0, 1.0), kind: str = "link") -> Body:
    inertial = Inertial(1.0, (0.1, 0.02, 0.0), ((0.02, 0.001, 0.0), (0.001, 0.03, 0.0), (0.0, 0.0, 0.04)))
    return Body(name, kind, parent, Placement(position), Joint("revolute", axis), inertial)  # type: ignore[arg-type]


def rotor(name: str, parent: str | None, position: tuple = (0.0, 0.0, 0.0)) -> Body:
    inertial = Inertial(0.1, (0.0, 0.0, 0.0), ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 2e-3)))
    return Body(name, "rotor", parent, Placement(position), Joint("revolute", (0.0, 0.0, 1.0)), inertial)


def four_bar(**changes) -> Robot:
    """A planar crank-rocker whose crank (0.15 m) can turn for ever; a rotor drives the rocker, so that `G_r` varies."""
    bodies = (
        link("crank", None, (0.0, 0.0, 0.0)),
        link("coupler", "crank", (0.15, 0.0, 0.0)),
        link("rocker", None, (0.3, 0.0, 0.0)),
        rotor("motor", "crank"),
    )
    pin = LoopConstraint(
        "pin", "revolute", "coupler", "rocker", Placement((0.3, 0.0, 0.0)), Placement((0.25, 0.0, 0.0))
    )
    gear = LinearConstraint("gear", (("motor", 1.0), ("coupler", -5.0), ("rocker", -2.0)))
    pose, assembly = Pose(joints=(("crank", 0.7),)), (("coupler", 0.3), ("rocker", 1.5))
    arguments = {"name": "four_bar", "bodies": bodies, "constraints": (pin, gear), "independent": ("crank",)}
    return Robot(**(arguments | {"pose": pose, "assembly": assembly} | changes))


def spatial_four_bar() -> Robot:
    """A crank and a rocker about skew axes, tied by a coupler with a ball joint at its end: no formula closes it."""
    tilted = (0.2 / 1.05**0.5, 0.1 / 1.05**0.5, 1.0 / 1.05**0.5)
    bodies = (
        link("crank", None, (0.0, 0.0, 0.0)),
        link("pitch", "crank", (0.1, 0.0, 0.0), (0.0, 1.0, 0.0)),
        link("coupler", "pitch", (0.0, 0.0, 0.0)),
        link("rocker", None, (0.45, 0.1, 0.05), tilted),
    )
    ball = LoopConstraint("ball", "ball", "coupler", "rocker", Placement((0.5, 0.0, 0.0)), Placement((0.3, 0.0, 0.0)))
    pose, assembly = Pose(joints=(("crank", 0.7),)), (("coupler", 0.0), ("rocker", 1.5))
    return Robot("spatial", bodies, (ball,), ("crank",), pose=pose, assembly=assembly)


def rod_leg(**changes) -> Robot:
    """A floating trunk with thigh and shank; a motor on the trunk moves the shank through a crank and a rod."""
    trunk = link("trunk", None, (0.0, 0.0, 0.0))
    bodies = (
        Body("trunk", "link", None, Placement(), Joint("free"), trunk.inertial),
        link("thigh", "trunk", (0.0, 0.1, 0.0)),
        link("shank", "thigh", (0.3, 0.0, 0.0)),
        link("crank", "trunk", (0.0, 0.1, 0.05)),
        rotor("motor", "trunk", (0.0, 0.1, 0.1)),
    )
    rod = RodConstraint("rod", "crank", "shank", (0.08, 0.0, 0.0), (0.05, 0.05, 0.05), 0.3)
    gear = LinearConstraint("gear", (("motor", 1.0), ("crank", -6.0)))
    pose, assembly = Pose(joints=(("thigh", 0.2), ("shank", 0.5))), (("crank", 0.9),)
    arguments = {"name": "rod_leg", "bodies": bodies, "constraints": (rod, gear), "independent": ("thigh", "shank")}
    return Robot(**(arguments | {"pose": pose, "assembly": assembly} | changes))
