"""Description of a scene, and functions for several scenes.

Joint targets, torques and pushes are constant for `HOLD` at a time, and every step length divides `HOLD`. So all codes
integrate the same motion with any step length.
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
"""Time between two changes of targets, torques or pushes, and between two recorded positions [s]."""

SLIP_SPEED = 1e-3
"""Slip speed of the contacts of every scene [m/s]."""


@dataclass(frozen=True)
class Way:
    """Settings of a curve of ce_gym.

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
        """Return the method and all settings that differ from the default."""
        friction = [] if self.friction == "tangent" else [self.friction]
        return ", ".join([self.method, *friction, *([SINGLE] if self.dtype == "float32" else [])])


METHODS_IN_CONTACT = ("euler", "extrapolated", "adaptive")
SINGLE = "single precision"
"""End of the name of a curve in single precision."""


@dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes:
        name: Name in tables and files.
        title: Title in pictures.
        robot: The robot without joint limits, with active contacts only.
        q: Initial positions, shape (nq,), without elastic stretches.
        v: Initial velocities, shape (nv,), without elastic stretches.
        drive: Joint targets [rad] or torques [N m] of every hold, shape (n_holds, n_joints).
        control: Kind of `drive`: targets or torques.
        push: Horizontal force on the base divided by the mass, world axes [m/s^2], shape (n_holds, 3), or None.
        ours: Curves of ce_gym.
        levels: Transmission levels of the peers.
        exact: Transmission level of the reference, without simplifications.
        terrain: The ground, constant along y; the plane z = 0 if None.
        touching: Pairs of links with contact between each other.
        spread: Standard deviation of the initial positions of the other robots of a batch [rad and m].
        reference: Steps per hold of the reference.
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
        """Return whether the scene has no contact."""
        return not self.robot.contacts and not self.touching

    @property
    def duration(self) -> float:
        """Return the simulated time [s]."""
        return self.holds * HOLD

    @property
    def holds(self) -> int:
        """Return the number of holds."""
        return len(self.drive)


SMOOTH = (Way("euler"), Way("extrapolated"), Way("rk4"), Way("adaptive"))
IN_CONTACT = tuple(Way(method, friction=how) for how in ("tangent", "secant") for method in METHODS_IN_CONTACT)
ROUGH = (*IN_CONTACT, *(replace(way, dtype="float32") for way in IN_CONTACT))
APPROXIMATE = Way("euler", "armature")


def unbounded(robot: Robot) -> Robot:
    """Return a robot without shapes and without limits of joints and torques, because limits are events."""
    bodies = tuple(
        replace(body, shapes=(), joint=replace(body.joint, position=(-np.inf, np.inf), torque=np.inf))
        for body in robot.bodies
    )
    return replace(robot, bodies=bodies)


def on_feet(name: str) -> Robot:
    """Return a robot with contacts of its feet only, with torque limits and without joint limits."""
    robot = bare(load_robot(name), "foot")
    bodies = tuple(replace(body, joint=replace(body.joint, position=(-np.inf, np.inf))) for body in robot.bodies)
    return replace(robot, bodies=bodies, material=replace(robot.material, slip_speed=SLIP_SPEED))


def driven(name: str, title: str, robot: Robot, duration: float, torque: float, ours: tuple[Way, ...]) -> Scene:
    """Return a scene from rest in the standing pose with sinusoidal torques of different frequencies, 1 to 3 Hz."""
    model = Model(robot)
    n, t = len(model.joint_links), HOLD * np.arange(round(duration / HOLD))[:, None]
    share = np.arange(n) / max(1, n - 1)
    drive = torque * np.sin(2 * np.pi * (1.0 + 2.0 * share) * t + 2.4 * np.arange(n))
    return Scene(name, title, robot, model.standing_q.copy(), np.zeros(model.nv), drive, ours=ours)


def diagonal(x: float, y: float, z: float) -> Mat3:
    """Return a diagonal matrix."""
    return (x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)
