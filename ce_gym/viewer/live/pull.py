"""A damped spring that pulls on a point of a body; implicit integration keeps it stable at any stiffness."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]

FREQUENCY = 10.0  # natural frequency of the robot's mass on the spring, critically damped [rad/s]
MOST = 1.5  # largest pull, in weights of the robot
GRAVITY = 9.81


def pulled(model: Model, q: Array, v: Array, dt: float, body: str, point: ArrayLike, target: ArrayLike) -> Array:
    """Return the velocities after a pull over a control step, applied as an impulse.

    The spring force at the end of the step is `f = K (target - x - dt u) - C u` with the velocity of the point
    `u = J (v + dt M^-1 J^T f)`: three linear equations. They leave out the motors, so that motors which hold a light
    limb reduce its pull.

    Args:
        model: The robot.
        q: Positions, shape (nq,).
        v: Velocities, shape (nv,).
        dt: Length of the step [s].
        body: Name of the pulled body.
        point: Point of the body, in its frame [m], shape (3,).
        target: Where to, in the world [m], shape (3,).
    """
    index = model.body_names.index(body)
    positions, rotations = model.body_poses(q)
    arm = rotations[index] @ np.asarray(point, float)
    place = positions[index] + arm
    responses = force_responses(model, q, v, body, place)  # M^-1 J^T, shape (nv, 3)
    velocity = point_velocity(model, q, v, index, arm)
    inverse_mass = np.stack([point_velocity(model, q, column, index, arm) for column in responses.T], axis=1)
    K = model.total_mass * FREQUENCY**2
    C = 2 * K / FREQUENCY
    spring = K * (np.asarray(target, float) - place - dt * velocity) - C * velocity
    force = np.linalg.solve(np.eye(3) + dt * (C + dt * K) * inverse_mass, spring)
    force *= min(1.0, MOST * model.total_mass * GRAVITY / max(float(np.linalg.norm(force)), 1e-9))
    return v + dt * responses @ force


def force_responses(model: Model, q: Array, v: Array, body: str, place: Array) -> Array:
    """Return the accelerations from forces of 1 N along the world's axes at a place of a body, shape (nv, 3)."""
    wrenches = np.concatenate([np.cross(place, np.eye(3)), np.eye(3)], axis=1)
    rows = np.concatenate([np.zeros((1, 6)), wrenches])
    q, v = np.tile(q, (4, 1)), np.tile(v, (4, 1))
    free, *forced = model.forward_dynamics(q, v, 0 * v, {body: rows})
    return np.stack([row - free for row in forced], axis=1)


def point_velocity(model: Model, q: Array, v: Array, index: int, arm: Array) -> Array:
    """Return the velocity of a point `arm` from the origin of a body, world axes [m/s]."""
    angular, linear = model.body_velocities(q, v)
    return linear[index] + np.cross(angular[index], arm)
