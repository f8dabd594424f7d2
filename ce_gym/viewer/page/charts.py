"""Signals for plots, and each joint's torque as a share of its limit."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.errors import listed_names
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page.poses import PosedRollout
from ce_gym.viewer.page.robot import body_paths

Array = NDArray[np.float64]

SPEEDS = {"forward speed [m/s]": 3, "sideways speed [m/s]": 4, "turning [rad/s]": 2}
"""Velocities of a floating base that can be commanded, in the order of commands: the column of `v`."""


@dataclass(frozen=True)
class Charts:
    """Signals of one rollout over its frames.

    Attributes:
        signals: By name with unit, each shape (F,).
        commanded: Commands, by the name of their signal, each shape (F,).
        limits: Largest absolute value of a signal, by name.
        effort: Absolute torque of each joint over its limit, 0 without a limit, shape (F, n_joints) or (F, 0).
        paths: Scene path of the link of each of these joints.
    """

    signals: Mapping[str, Array]
    commanded: Mapping[str, Array]
    limits: Mapping[str, float]
    effort: Array
    paths: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the data for the page: signals as base64 of float32, effort as base64 of bytes, 255 at the limit."""
        effort = np.clip(np.rint(255 * self.effort), 0, 255).astype(np.uint8)
        return {
            "signals": {name: packed(values) for name, values in self.signals.items()},
            "commanded": {name: packed(values) for name, values in self.commanded.items()},
            "limits": dict(self.limits),
            "effort": base64.b64encode(effort.tobytes()).decode(),
            "paths": list(self.paths) if effort.shape[1] else [],
        }


def packed(values: Array) -> str:
    """Return numbers as base64 of float32."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def charts(run: PosedRollout) -> Charts:
    """Return the signals of a posed rollout.

    Raises:
        ViewerError: The number of torques is not the robot's number of joints.
    """
    rollout, rows, robot = run.rollout, run.frames, run.robot
    joints, torques, v = robot.commanded, rollout.torques[rows], rollout.v[rows]
    if torques.shape[1] not in (0, len(joints)):
        raise ViewerError(
            f"rollout of {rollout.robot!r} has torques of {torques.shape[1]} joints; the robot has {len(joints)}"
        )
    signals: dict[str, Array] = {}
    commanded: dict[str, Array] = {}
    limits: dict[str, float] = {}
    if robot.floating and v.shape[1] >= 6:
        signals |= {name: v[:, column] for name, column in SPEEDS.items()}
        commanded |= dict(zip(SPEEDS, rollout.commands[rows].T, strict=False))
        signals["height of the base [m]"] = run.positions[:, 0, 2]
    if rollout.contact_forces.shape[1]:
        signals["force from the ground [N]"] = rollout.contact_forces[rows, :, 2].sum(1)
    signals |= dict(zip(rollout.signal_names, rollout.signals[rows].T, strict=True))
    bodies = [robot.body(name) for name in joints]
    for kind, unit, values in (("torque", "N m", torques), ("speed", "rad/s", v[:, v.shape[1] - len(joints) :])):
        for body, column in zip(bodies, values.T, strict=values.shape[1] > 0):
            joint = robot.joint_name(body.name).removesuffix("_joint").removesuffix("_link")
            name = f"{kind} of {joint} [{unit}]"
            limit = body.joint.torque if kind == "torque" else body.joint.velocity
            signals[name] = column
            limits |= {name: limit} if np.isfinite(limit) else {}
    paths = body_paths(robot, run.path)
    largest = np.array([body.joint.torque or np.inf for body in bodies])  # the limit of a passive joint is 0
    effort = np.abs(torques) / largest if torques.shape[1] else np.empty((len(rows), 0))
    return Charts(signals, commanded, limits, effort, tuple(paths[name] for name in joints))


def default_plots(all_charts: Sequence[Charts], wanted: Sequence[str]) -> list[str]:
    """Return the names of the signals to plot first.

    Args:
        all_charts: Signals of each rollout.
        wanted: Names, or beginnings of names; if empty, the speed, the joint closest to its torque limit and the
            reward are plotted.

    Raises:
        ViewerError: There is no such signal; the message lists the known ones.
    """
    known = list(dict.fromkeys(name for chart in all_charts for name in chart.signals))
    names = []
    for word in wanted:
        matches = [name for name in known if name.startswith(word)] or [name for name in known if word in name]
        if not matches:
            raise ViewerError(f"no signal {word!r} to plot; expected one of {listed_names(word, known)}")
        names.append(matches[0])
    if names or not all_charts:
        return names
    first = all_charts[0]
    torques = [name for name in first.signals if name.startswith("torque of")]
    hardest = [torques[int(first.effort.max(0).argmax())]] if torques else []
    order = ["forward speed [m/s]", *hardest, "reward", "force from the ground [N]", *known]
    return [name for name in dict.fromkeys(order) if name in known][:3]
