"""What a scene is, and what many of them share.

Everything is held for `HOLD` at a time, joint targets, torques and pushes alike, so that every code integrates the same
motion whatever its step, and every step length divides `HOLD`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.peers.stand import bare
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot
from ce_gym.model.frames import Mat3
from ce_gym.sim.terrain import Terrain

Array = NDArray[np.float64]

HOLD = 0.02
"""How long a target, torque or push is held, and the time between two recorded positions [s]."""

SLIP_SPEED = 1e-3
"""Slip speed of the contacts of every scene [m/s]."""


@dataclass(frozen=True)
class Way:
    """How one of our curves is computed.

    Attributes:
        method: Name of a time-stepping method.
        level: Transmission level.
        friction: "tangent" or "secant".
        dtype: Precision of state and arithmetic.
    """

    method: str
    level: str = "exact"
    friction: str = "tangent"
    dtype: str = "float64"

    @property
    def name(self) -> str:
        """Method, and what is not the default."""
        friction = [] if self.friction == "tangent" else [self.friction]
        return ", ".join([self.method, *friction, *([SINGLE] if self.dtype == "float32" else [])])


METHODS_IN_CONTACT = ("euler", "extrapolated", "adaptive")
SINGLE = "single precision"
"""What the name of such a way ends with."""


@dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes:
        name: For tables and files.
        title: For pictures.
        robot: Limits of joints left out, only contacts that take part.
        q: Positions at the start, shape (nq,), without stretches of transmissions, as all that is recorded.
        v: Velocities at the start, shape (nv,), likewise.
        drive: Joint targets [rad] or torques [N m] of every hold, shape (n_holds, n_joints).
        control: What `drive` is.
        push: Acceleration of the base in place of a horizontal force, world axes [m/s^2], shape (n_holds, 3), or None.
        ours: Our curves.
        levels: Transmission levels of the peers.
        exact: Transmission level that leaves nothing out of what the scene is.
        terrain: The ground, alike along y; the plane z = 0 if None.
        touching: Pairs of links that push each other apart.
        spread: Standard deviation of the starting positions of the other robots of a batch [rad and m].
        reference: Steps to a hold of the reference.
    """

    name: str
    title: str
    robot: Robot
    q: Array
    v: Array
    drive: Array
    control: Literal["torque", "position"] = "torque"
    push: Array | None = None
    ours: tuple[Way, ...] = ()
    levels: tuple[str, ...] = ("armature", "exact")
    exact: str = "exact"
    terrain: Terrain | None = None
    touching: tuple[tuple[str, str], ...] = ()
    spread: float = 0.01
    reference: int = 100

    @property
    def smooth(self) -> bool:
        """Whether nothing touches anything."""
        return not self.robot.contacts and not self.touching

    @property
    def duration(self) -> float:
        """Simulated time [s]."""
        return self.holds * HOLD

    @property
    def holds(self) -> int:
        """How many times the drive changes, the start included."""
        return len(self.drive)


SMOOTH = (Way("euler"), Way("extrapolated"), Way("rk4"), Way("adaptive"))
IN_CONTACT = tuple(Way(method, friction=how) for how in ("tangent", "secant") for method in METHODS_IN_CONTACT)
ROUGH = (*IN_CONTACT, *(replace(way, dtype="float32") for way in IN_CONTACT))
APPROXIMATE = Way("euler", "armature")


def unbounded(robot: Robot) -> Robot:
    """Return a robot without limits of joints and torques, and without shapes: limits are events of their own."""
    bodies = tuple(
        replace(body, shapes=(), joint=replace(body.joint, position=(-np.inf, np.inf), torque=np.inf))
        for body in robot.bodies
    )
    return replace(robot, bodies=bodies)


def on_feet(name: str) -> Robot:
    """Return a robot that only its feet keep above the ground, with limited torques but free joints."""
    robot = bare(load_robot(name), "foot")
    bodies = tuple(replace(body, joint=replace(body.joint, position=(-np.inf, np.inf))) for body in robot.bodies)
    return replace(robot, bodies=bodies, material=replace(robot.material, slip_speed=SLIP_SPEED))


def driven(name: str, title: str, robot: Robot, duration: float, torque: float, ours: tuple[Way, ...]) -> Scene:
    """Start at rest in the standing pose; every joint has a frequency between 1 and 3 Hz and a phase of its own."""
    model = Model(robot)
    n, t = len(model.joint_links), HOLD * np.arange(round(duration / HOLD))[:, None]
    share = np.arange(n) / max(1, n - 1)
    drive = torque * np.sin(2 * np.pi * (1.0 + 2.0 * share) * t + 2.4 * np.arange(n))
    return Scene(name, title, robot, model.standing_q.copy(), np.zeros(model.nv), drive, ours=ours)


def diagonal(x: float, y: float, z: float) -> Mat3:
    """Return a diagonal matrix."""
    return (x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)
