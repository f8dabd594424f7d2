"""The page of a robot file: a slider for each independent joint; gears and loops follow by the robot's constraints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.dynamics.quantities.configurations import joint_range
from ce_gym.model import Robot
from ce_gym.model.arguments import check, is_number
from ce_gym.model.options import one_of
from ce_gym.viewer.live.messages import checked, parsed
from ce_gym.viewer.page.html import filled, packed_commands
from ce_gym.viewer.page.moving import MovingScene
from ce_gym.viewer.page.robot import extent, pose_bodies
from ce_gym.viewer.stream import LivePage

Array = NDArray[np.float64]

PERIOD = 1 / 60  # between two looks for a message of the page [s]
BISECTIONS = 20  # to find how far a slider moves before a loop opens


class RobotPage(LivePage):
    """Shows one robot in the configuration that the sliders of the page set.

    A slider moves one row of `v`: a joint angle or travel, or a component of the rotation vector of a ball joint. A
    floating base stays in its standing pose.

    Args:
        robot: The robot.

    Attributes:
        model: The robot at level "exact".
        values: Present values of the sliders [rad or m], shape (n,).

    Raises:
        RobotError: The robot is not valid.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__("view")
        self.model = Model(robot)
        standing = _standing_q(self.model)
        self.scene = MovingScene(self.model, standing)
        layout = self.model.robot.layout
        self._base = layout.base_nv
        self._origin = np.concatenate([standing[: layout.base_nq], self.model.neutral()[layout.base_nq :]])
        self.standing = self.model.difference(self._origin, standing)[self._base :]
        self.sliders = self._sliders()
        self._summary = self.model.describe().splitlines()[0].partition(": ")[2]
        self.values = self._wanted = self.standing
        self._is_sent = False

    def _sliders(self) -> list[dict[str, Any]]:
        """Return name, range and further data of each slider, in the order of `v`."""
        robot, sliders = self.model.robot, []
        for name, (_, rows) in robot.rows.items():
            joint = robot.body(name).joint
            for row, axis in zip(rows, (" x", " y", " z") if joint.type == "ball" else ("",), strict=False):
                if row >= self._base:
                    low, high = joint_range(joint, self.standing[row - self._base])
                    sliders.append({**_row(robot, name), "low": low, "high": high})
                    sliders[-1]["name"] += axis
        return sliders

    def html(self) -> str:
        """Return the page."""
        robot = self.model.robot
        dependent = [name for name in robot.joints if name not in robot.rows]
        return filled(
            "robot",
            robot.name,
            scripts=("belts", "overlays", "stream", "robot"),
            constants={
                "COMMANDS": packed_commands(self.scene.commands()),
                "SLIDERS": self.sliders,
                "STANDING": self.standing.tolist(),
                "DEPENDENT": [_row(robot, name) for name in dependent],
                "SUMMARY": self._summary,
            },
        )

    def receive(self, body: bytes) -> None:
        """Take the message `{"do": "move", "values": [...]}` with the value of each slider.

        Raises:
            ValueError: The message is not valid.
        """
        message = parsed(body)
        one_of(("move",))("do", message.get("do"))
        self._wanted = checked(message, {"values": self._checked_values})["values"]
        self._is_sent = False

    def _checked_values(self, name: str, values: Any) -> Array:
        count = len(self.sliders)
        valid = isinstance(values, list) and len(values) == count and all(map(is_number, values))
        check(name, values, valid, f"{count} numbers")
        limits = np.array([(slider["low"], slider["high"]) for slider in self.sliders]).reshape(count, 2)
        return np.clip(np.array(values, float), *limits.T)

    def update(self) -> float:
        """Move the robot and send its pose after a message; return the time until the next update [s]."""
        if not self._is_sent:
            self._is_sent = True
            self.move_to(self._wanted)
            self.scene.send(self.feed, [self.model], [self.q(self.values)], self.state())
        return PERIOD

    def move_to(self, values: Array) -> None:
        """Move the sliders to `values`, or towards them as far as the robot's loops close."""
        start, low, high = self.values, 0.0, 1.0
        self.notice = ""
        if not self._closes(values):
            self.notice = "the loops of the robot do not close beyond this pose"
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                low, high = (middle, high) if self._closes(start + middle * (values - start)) else (low, middle)
            values = start + low * (values - start)
        self.values = values

    def _closes(self, values: Array) -> bool:
        try:
            self.model.spanning(self.q(values), np.zeros(self.model.nv))
        except ValueError:
            return False
        return True

    def q(self, values: Array) -> Array:
        """Return the positions for values of the sliders, shape (nq,)."""
        return self.model.integrate(self._origin, np.concatenate([np.zeros(self._base), values]))

    def state(self) -> dict[str, Any]:
        """Return the values of the sliders and of the dependent joints."""
        robot = self.model.robot
        q_span, _ = self.model.spanning(self.q(self.values), np.zeros(self.model.nv))
        dependent = [rows[0] for name, (rows, _) in robot.spanning_rows.items() if name not in robot.rows]
        return {
            "values": self.values.round(5).tolist(),
            "dependent": q_span[dependent].round(5).tolist(),
            "notice": self.notice,
        }


def _standing_q(model: Model) -> Array:
    """Return the standing pose, shape (nq,); a robot whose file has no contacts stands on its lowest shape."""
    q, robot = model.standing_q.copy(), model.robot
    if robot.floating and not robot.contacts:
        positions, rotations = pose_bodies(model, [q])
        q[2] -= extent(robot, positions[0], rotations[0]).low[2]
    return q


def _row(robot: Robot, name: str) -> dict[str, Any]:
    """Return what the page's table shows of a joint."""
    joint = robot.body(name).joint
    return {
        "name": robot.joint_name(name).removesuffix("_joint"),
        "link": name,
        "unit": "m" if joint.type == "prismatic" else "rad",
        "limits": [x if np.isfinite(x) else None for x in joint.position],
        "effort": joint.torque if np.isfinite(joint.torque) else None,
    }
