"""Loops, rods and functions in robot files; `error_cases.yaml` has the mistakes."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.model import load_robot, register_constraint


@pytest.fixture
def read(write_robot):
    """Return a function that reads the leg with a constraint between its joints."""

    def load(entry: str, *edits: tuple[str, str]):
        keys = f"constraints: [{entry}]\nindependent: [thigh]\nassembly: {{shank: 0.4}}"
        robot = load_robot(write_robot(("gains: {kp: 20, kd: {thigh: 1, shank: 2}}", keys), *edits))
        assert robot.assembly == (("shank", 0.4),)
        return robot.constraints[-1]

    return load


def test_rods(read):
    rod = read("{name: r, type: rod, length: 0.3, first: {body: trunk, point: [0, 0, 0.1]},"
               " second: {body: foot, point: [0, 0, 0]}}")  # fmt: skip
    assert (rod.first, rod.second, rod.length) == ("trunk", "shank", 0.3)
    assert rod.second_point == (0.0, 0.0, -0.3)  # the foot is welded to the shank


def test_loops(read):
    ball = read("{name: b, type: loop, joint: ball, first: {body: thigh, xyz: [1, 2, 3]}, second: {body: foot}}")
    assert ball.joint == "ball"
    assert ball.first_placement.position == (1.0, 2.0, 3.0)
    loop = read("{name: l, type: loop, joint: revolute, axis: [0, 1, 0], first: {body: foot, rpy: [0, 0, 1.5]},"
                " second: {body: world}}", ("base: floating", "base: fixed"))  # fmt: skip
    assert (loop.first, loop.second, loop.axis) == ("shank", None, (0.0, 1.0, 0.0))
    np.testing.assert_allclose(np.array(loop.first_placement.rotation)[:, 0], [np.cos(1.5), np.sin(1.5), 0], atol=1e-15)


def test_functions(read):
    register_constraint("test_file", lambda q: [2 * q[0]])
    tie = read("{name: f, type: function, function: test_file, arguments: [thigh], dependent: [shank]}")
    assert tie.bodies == ("shank", "thigh")
