"""Loops, rods and functions in robot files: read as written, and refused in one line when they are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.model import FunctionConstraint, LoopConstraint, RobotError, RodConstraint, load_robot, register_constraint

ROD = (
    "- {name: r, type: rod, length: 0.3, first: {body: trunk, point: [0, 0, 0.1]}, "
    "second: {body: foot, point: [0, 0, 0]}}"
)
LOOP = (
    "- {name: l, type: loop, joint: revolute, axis: [0, 1, 0], first: {body: foot, rpy: [0, 0, 1.5]}, "
    "second: {body: world}}"
)
BALL = "- {name: b, type: loop, joint: ball, first: {body: thigh, xyz: [1, 2, 3]}, second: {body: foot}}"
FUNCTION = "- {name: f, type: function, function: test_file, arguments: [thigh], dependent: [shank]}"
MORE = "independent: [thigh]\nassembly: {shank: 0.4}\ngains:"


@pytest.fixture(autouse=True)
def function():
    register_constraint("test_file", lambda q: [2 * q[0]])


def with_constraint(write_robot, entry: str, more: str = MORE, *edits) -> Path:
    gains = ("gains: {kp: 20, kd: {thigh: 1, shank: 2}}", "gains: {kp: 20, kd: 1}")
    return write_robot(gains, ("gains:", f"constraints:\n{entry}\n{more}"), *edits)


def test_rods_loops_and_functions_are_read(write_robot):
    (rod,) = [c for c in load_robot(with_constraint(write_robot, ROD)).constraints if isinstance(c, RodConstraint)]
    assert (rod.first, rod.second, rod.length) == ("trunk", "shank", 0.3)
    assert rod.second_point == (0.0, 0.0, -0.3)  # the foot is welded to the shank
    robot = load_robot(with_constraint(write_robot, BALL))
    (ball,) = [c for c in robot.constraints if isinstance(c, LoopConstraint)]
    assert ball.joint == "ball"
    assert ball.first_placement.position == (1.0, 2.0, 3.0)
    assert robot.assembly == (("shank", 0.4),)
    fixed = ("base: floating", "base: fixed")
    (loop,) = [
        c
        for c in load_robot(with_constraint(write_robot, LOOP, MORE, fixed)).constraints
        if isinstance(c, LoopConstraint)
    ]
    assert (loop.first, loop.second, loop.axis) == ("shank", None, (0.0, 1.0, 0.0))
    np.testing.assert_allclose(np.array(loop.first_placement.rotation)[:, 0], [np.cos(1.5), np.sin(1.5), 0], atol=1e-15)
    (tie,) = [
        c for c in load_robot(with_constraint(write_robot, FUNCTION)).constraints if isinstance(c, FunctionConstraint)
    ]
    assert tie.bodies == ("shank", "thigh")


@pytest.mark.parametrize(
    ("entry", "more", "parts"),
    [
        (ROD.replace("0.3", "-1"), MORE, ["'r' length", "-1.0", "above 0"]),
        (ROD.replace("length: 0.3, ", ""), MORE, ["constraints[0].length", "missing"]),
        (ROD.replace("foot", "feet"), MORE, ["constraints[0].second.body", "'feet'", "the name of a body"]),
        (ROD.replace("trunk", "shank"), MORE, ["constraint 'r'", "two different bodies"]),
        (ROD.replace("trunk", "world"), MORE, ["constraint", "r is", "free joint of trunk"]),
        (ROD.replace("point: [0, 0, 0.1]", "point: [0, 0]"), MORE, ["constraints[0].first.point", "3 numbers"]),
        (ROD.replace("point: [0, 0, 0.1]", "point: [0, 0, .nan]"), MORE, ["constraints[0].first.point[2]", "finite"]),
        (ROD.replace("length", "lenght"), MORE, ["'lenght'", "did you mean 'length'"]),
        (LOOP.replace("revolute", "prismatic"), MORE, ["constraints[0].joint", "'prismatic'", "revolute, ball"]),
        (LOOP.replace("[0, 1, 0]", "[0, 0, 0]"), MORE, ["constraints[0].axis"]),
        (BALL.replace("ball,", "ball, axis: [0, 0, 1],"), MORE, ["constraints[0].axis", "a ball joint has none"]),
        (BALL.replace("thigh", "shank"), MORE, ["constraint 'b'", "two different bodies"]),
        (FUNCTION.replace("test_file", "nobody_wrote_it"), MORE, ["constraint 'f'", "nobody_wrote_it", "registered"]),
        (FUNCTION.replace("[thigh]", "[thih]"), MORE, ["'thih'", "did you mean 'thigh'"]),
        (FUNCTION.replace("[thigh]", "[]"), MORE, ["constraint 'f'"]),
        (FUNCTION.replace("[thigh]", "[trunk]"), MORE, ["constraint 'f'", "'trunk'", "one degree of freedom"]),
        (ROD, "gains:", ["independent is missing", "loops and functions do not say which"]),
        (ROD, "independent: [thigh]\nassembly: {thigh: 1}\ngains:", ["assembly", "'thigh'", "dependent joint"]),
        (ROD, "independent: [thigh]\nassembly: {shank: .inf}\ngains:", ["assembly.shank", "finite"]),
    ],
)
def test_one_line_says_what_is_wrong(write_robot, entry, more, parts):
    with pytest.raises(RobotError) as caught:
        load_robot(with_constraint(write_robot, entry, more))
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message
