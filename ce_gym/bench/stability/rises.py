"""What adds to mechanical energy in a step without motors: the motion, the springs of contacts, their bristles, stops.

A step changes the energy of a robot by what contacts and stops do on it, and by the error of the step; and that of a
spring by what is done on it, and by what the step did not foresee. With the forces of the step and the velocities at
its end, which they are taken at, these errors are known, and add up to the change of the sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.forces.passive import stop_springs
from ce_gym.dynamics.model import Model

Array = NDArray[Any]
Rows = Mapping[str, Array]
"""What robots carry before or after a step, see `Simulator.snapshot`."""
SOURCES = ("motion", "springs", "bristles", "stops")


@dataclass
class Largest:
    """The step of each robot in which its energy rose most.

    Attributes:
        rise: By how much [J], shape (n,).
        step: Which, shape (n,).
        before: Rows of the robots before it.
        after: Likewise after it.
        forces: On the contacts during it [N], shape (n, n_contacts, 3).
    """

    rise: Array
    step: Array
    before: dict[str, Array]
    after: dict[str, Array]
    forces: Array

    @classmethod
    def none(cls, rows: Rows, forces: Array) -> Largest:
        """Return that of robots that have made no step."""
        n, copies = len(forces), [{name: array.copy() for name, array in rows.items()} for _ in range(2)]
        return cls(np.zeros(n), np.zeros(n, dtype=np.int64), *copies, forces.copy())  # type: ignore[call-arg]  # two of them

    def take(self, step: int, rise: Array, before: Rows, after: Rows, forces: Array) -> None:
        """Keep a step for those whose energy rises more in it than in any so far."""
        more = rise > self.rise
        if more.any():
            self.rise[more], self.step[more], self.forces[more] = rise[more], step, forces[more]
            for name in self.before:
                self.before[name][more], self.after[name][more] = before[name][more], after[name][more]


def sources(model: Model, largest: Largest, stiffness: Array, dt: float) -> Array:
    """Return what each of SOURCES adds to the rise [J], shape (n, 4); they sum up to it.

    Args:
        model: A robot on flat ground.
        largest: Steps of its copies.
        stiffness: Of their grounds [N/m], shape (n,).
        dt: [s].
    """
    before, after, F = largest.before, largest.after, largest.forces
    u = _point_velocities(model, before["q"], after["v"])
    springs, bent = _springs(model, before["q"], stiffness), _springs(model, after["q"], stiffness)
    anchors = [0.5 * model.robot.material.bristle * np.sum(rows["anchor"] ** 2, axis=1) for rows in (before, after)]
    ends = _stops(model, before, after, dt)
    normal = bent - springs + dt * np.sum(F[..., 2] * u[..., 2], axis=1)
    along = anchors[1] - anchors[0] + dt * np.sum(F[..., :2] * u[..., :2], axis=(1, 2))
    return np.stack([largest.rise - normal - along - ends, normal, along, ends], axis=1)


def _point_velocities(model: Model, q: Array, v: Array) -> Array:
    """Return the velocities of the lowest points of the contact spheres, shape (n, n_contacts, 3)."""
    _, centres = model.contact_points(q, v)
    angular, _ = model.body_velocities(q, v)
    bodies = np.array([model.body_names.index(contact.body) for contact in model.robot.contacts], dtype=np.int64)
    down = np.array([[0.0, 0.0, -contact.radius] for contact in model.robot.contacts]).reshape(-1, 3)
    return centres + np.cross(angular[:, bodies], down)


def _springs(model: Model, q: Array, stiffness: Array) -> Array:
    """Return the energy of the ground's springs [J], shape (n,)."""
    centres, _ = model.contact_points(q, np.zeros((len(q), model.nv)))
    radii = np.array([contact.radius for contact in model.robot.contacts])
    return 0.5 * stiffness * np.sum(np.maximum(radii - centres[..., 2], 0.0) ** 2, axis=1)


def _stops(model: Model, before: Rows, after: Rows, dt: float) -> Array:
    """Return what stops of independent joints store in a step, and do on the robot [J], shape (n,).

    Whether a stop acts is decided by the velocities at the start, how hard it pushes by those at the end.
    """
    robot, springs, total = model.robot, stop_springs(model.mechanism), np.zeros(len(before["q"]))
    for i, name in enumerate(robot.independent):
        k, c = springs[name]
        at, to = (rows["q"][:, robot.layout.joints_q + i] for rows in (before, after))
        start, end = (rows["v"][:, robot.layout.joints_v + i] for rows in (before, after))
        for bound, side in zip(robot.body(name).joint.position, (1.0, -1.0), strict=True):
            depth, deeper = side * (bound - at), side * (bound - to)
            damped = c + dt * k
            acts = np.where(depth > 0, k * depth > c * side * start, depth > dt * side * start)
            push = np.where(acts, k * depth - damped * side * end, 0.0) if np.isfinite(bound) else 0.0
            total += dt * push * side * end
            total += 0.5 * k * (np.maximum(deeper, 0.0) ** 2 - np.maximum(depth, 0.0) ** 2)
    return total
