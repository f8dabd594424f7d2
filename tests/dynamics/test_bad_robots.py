"""Robots made by hand that cannot be: one clear line each, at the latest when a `Model` is made."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import casadi as ca
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import (
    Body,
    ContactSphere,
    FunctionConstraint,
    Inertial,
    Joint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Robot,
    RobotError,
    RodConstraint,
    check_robot,
    register_constraint,
)

SOLID = Inertial(1.0, (0.0, 0.0, 0.0), ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)))
POINT = Inertial(1.0, (0.0, 0.0, 0.0), ((0.0,) * 3,) * 3)
NOTHING = replace(POINT, mass=0.0)


def body(name: str, parent: str | None, kind: str = "revolute", inertial: Inertial = SOLID, **fields) -> Body:
    return Body(name, fields.pop("body", "link"), parent, Placement(), Joint(kind, **fields), inertial)  # type: ignore[arg-type]


def robot(*bodies: Body, ties: tuple = (), independent: tuple[str, ...] = (), **fields) -> Robot:
    return Robot("bad", bodies, ties, independent, **fields)


def build(described: Robot) -> Model:
    check_robot(described)
    return Model(described)


BASE, LEG = body("base", None, "free"), body("leg", "base")
MOTOR, GEAR = body("motor", "base", body="rotor"), LinearConstraint("gear", (("motor", 1.0), ("leg", -6.0)))
HELD = "bad: constraint tie is ('base',): expected a tie that does not reach across the free joint of base"

IMPOSSIBLE = {
    "a ball joint holds the base": (
        robot(BASE, LEG, ties=(LoopConstraint("tie", "ball", "base", None),), independent=("leg",)),
        HELD,
    ),
    "a hinge holds the base": (
        robot(BASE, LEG, ties=(LoopConstraint("tie", "revolute", None, "base"),), independent=("leg",)),
        HELD,
    ),
    "a rod holds the base": (
        robot(BASE, LEG, ties=(RodConstraint("tie", "base", None, (0.0,) * 3, (0.0, 0.0, 1.0), 1.0),)),
        HELD,
    ),
    "a leg is pinned to the world": (
        robot(BASE, LEG, ties=(LoopConstraint("tie", "ball", "leg", None),), independent=("leg",)),
        "the free joint of base",
    ),
    "a gear turns the base": (
        robot(BASE, LEG, ties=(LinearConstraint("tie", (("base", 1.0), ("leg", 2.0))),)),
        "constraint 'tie' is 'base': expected a body whose joint has one degree of freedom",
    ),
    "a rotor touches the ground": (
        robot(
            *(BASE, LEG, MOTOR),
            ties=(GEAR,),
            independent=("leg",),
            contacts=(ContactSphere("toe", "motor", (0.0,) * 3, 0.1),),
        ),
        "bad: contacts.toe.body is 'motor': expected a link",
    ),
    "a rotor carries a link": (
        robot(BASE, LEG, MOTOR, body("hand", "motor"), ties=(GEAR,), independent=("leg", "hand")),
        "rotor 'motor' carries another body",
    ),
    "a point mass on its own axis": (
        robot(body("a", None, inertial=POINT), independent=("a",)),
        "bad: link 'a' inertia is ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)): expected a mass or an inertia",
    ),
    "a point mass that floats": (robot(body("a", None, "free", POINT)), "link 'a' inertia"),
    "a rotor of nothing, tied to nothing": (
        robot(body("leg", None), body("motor", None, inertial=NOTHING, body="rotor"), independent=("leg", "motor")),
        "rotor 'motor' inertia",
    ),
    "an axis of two numbers": (robot(body("a", None, axis=(0.0, 1.0)), independent=("a",)), "joint axis is (0.0, 1.0)"),
    "a loop that is a joint already": (
        robot(body("a", None), body("b", "a"), ties=(LoopConstraint("tie", "ball", "a", "b"),), independent=("a", "b")),
        "tied by tie, is redundant, because joints and linear constraints imply it: expected it left out",
    ),
    "a rod of no length": (
        robot(
            *(body("a", None), body("b", "a")),
            ties=(RodConstraint("tie", None, "b", (0.0,) * 3, (0.0,) * 3, 1e-12),),
            independent=("a",),
        ),
        "tied by tie",
    ),
}


@pytest.mark.parametrize(("bad", "says"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_robots(bad: Robot, says: str):
    with pytest.raises(RobotError, match=re.escape(says)) as caught:
        build(bad)
    assert "\n" not in str(caught.value)


FUNCTIONS = {
    # the function, and the error if its constraint is explicit and if it is implicit
    "index": (lambda q: [q[5]], "fails with IndexError: list index out of range", None),
    "none": (lambda q: None, "fails with TypeError", None),
    "text": (lambda q: "a", "returned 'a': expected numbers and expressions", None),
    "columns": (lambda q: [ca.vertcat(q[0], q[0])], "expected numbers and expressions, one for each row", None),
    "branches": (lambda q: [q[0] if q[0] > 0 else -q[0]], "fails with RuntimeError", None),
    "not a number": (lambda q: [q[0] * math.nan], "is not a number at the standing pose", None),
    "no root": (lambda q: [ca.sqrt(q[0] - 5.0)], "is not a number at the standing pose", None),
    "too large": (lambda q: [q[0] * 1e300 * 1e300], "is not a number at the standing pose", None),
    "constant": (lambda q: [3.0], "", "does not close at the standing pose"),
    "one of two": (lambda q: [q[0]], "", "expected independent joints that determine d"),
}


@pytest.mark.parametrize("dependent", [("d",), ()], ids=["explicit", "implicit"])
@pytest.mark.parametrize(("function", "explicit", "implicit"), FUNCTIONS.values(), ids=FUNCTIONS)
def test_functions_of_users(function, explicit: str, implicit: str | None, dependent: tuple[str, ...]):
    register_constraint("test_bad", function)
    tie = FunctionConstraint("tie", "test_bad", ("c",) if dependent else ("c", "d"), dependent)
    bad = robot(body("a", None), body("c", "a"), body("d", "a"), ties=(tie,), independent=("a", "c"))
    says = explicit if dependent or implicit is None else implicit
    if not says:
        assert build(bad).mass_matrix([0.1, 0.2]).shape == (2, 2)
        return
    with pytest.raises(RobotError, match=re.escape(says)) as caught:
        build(bad)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("bad: ")
    assert caught.value.__cause__ is None
