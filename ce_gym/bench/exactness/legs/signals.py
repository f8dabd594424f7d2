"""What the legs have to follow: chirps of joints and of the foot, and swing legs at running speed."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.exactness.protocol import (
    AMPLITUDE,
    CLEARANCE,
    CORNER,
    COUNTED,
    FASTEST,
    FOOT_AMPLITUDE,
    HOLD,
    POSE_SPREAD,
    POSES,
    REACH,
    SETTLE,
    SLOWEST,
    SWEEP,
    Array,
    Leg,
)
from ce_gym.dynamics.model import Model

Series = tuple[Array, NDArray[np.complex128]]
"""Mean and complex amplitudes of harmonics."""
SAMPLES, HARMONICS = 128, 12
"""Poses of a stride that inverse kinematics finds, and harmonics that are kept of them."""


@dataclass(frozen=True)
class Motion:
    """A motion to follow: positions, velocities and accelerations, each of shape (n_times, n_poses, n)."""

    x: Array
    xd: Array
    xdd: Array


def centres(model: Model, seed: int, amplitude: float = AMPLITUDE) -> tuple[Array, Array]:
    """Return centres of motion, shape (n_poses, nq), and the amplitude of each joint that stays in its range (nq,)."""
    low, high = np.array([model.robot.body(name).joint.position for name in model.joint_links]).T
    room = np.minimum(amplitude, REACH * (high - low))
    noise = np.random.default_rng(seed).uniform(-POSE_SPREAD, POSE_SPREAD, (POSES, model.nq))
    return np.clip(model.standing_q + noise, low + room, high - room), room


def chirp(times: Array) -> tuple[Array, Array, Array]:
    """Return a chirp of amplitude 1 below the corner frequency, and its derivatives, each of shape (n_times,)."""
    t = ca.SX.sym("t")
    frequency = SLOWEST + (FASTEST - SLOWEST) * t / SWEEP
    phase = 2 * ca.pi * (SLOWEST * t + (FASTEST - SLOWEST) * t**2 / (2 * SWEEP))
    wave = ca.sin(phase) / (1 + (frequency / CORNER) ** 4) ** 0.25
    rate = ca.jacobian(wave, t)
    values = ca.Function("chirp", [t], [wave, rate, ca.jacobian(rate, t)]).map(len(times))(times)
    return tuple(np.array(value).ravel() for value in values)  # type: ignore[return-value]


def chirp_times() -> tuple[Array, Array]:
    """Return the times of control [s] and the chirp's frequency at them [Hz]."""
    times = np.arange(0.0, SWEEP, HOLD)
    return times, SLOWEST + (FASTEST - SLOWEST) * times / SWEEP


def joint_chirp(model: Model, seed: int) -> Motion:
    """Return the chirp of all joints in phase, about the centres."""
    centre, room = centres(model, seed)
    x, xd, xdd = (value[:, None, None] * room for value in chirp(chirp_times()[0]))
    still = np.zeros_like(centre)
    return Motion(x + centre, xd + still, xdd + still)


def foot_chirp(model: Model, seed: int) -> tuple[Motion, Array]:
    """Return the chirp of the foot, and the poses it starts from, shape (n_poses, nq)."""
    centre, _ = centres(model, seed)
    place = foot_at(model, centre)
    along = FOOT_AMPLITUDE * np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    x, xd, xdd = (value[:, None, None] * along for value in chirp(chirp_times()[0]))
    still = np.zeros_like(place)
    return Motion(x + place, xd + still, xdd + still), centre


def stride(model: Model, leg: Leg, centre: Array) -> Series:
    """Return the Fourier series of the joints in a stride whose lowest point is the foot's place at the centres.

    Returns:
        Mean, shape (n_poses, nq), and complex amplitudes of harmonics 1, 2, ..., shape (n_harmonics, n_poses, nq).
    """
    phase = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    length = leg.speed / (np.pi * leg.frequency)
    ellipse = np.stack([-length / 2 * np.sin(phase), 0 * phase, CLEARANCE / 2 * (1 - np.cos(phase))], axis=-1)
    places = foot_at(model, centre) + ellipse[:, None]
    q = np.empty((SAMPLES, *centre.shape))
    guess = centre
    for i, place in enumerate(places):
        q[i] = guess = reach(model, place, guess, centre)
    series = np.fft.rfft(q, axis=0) / SAMPLES
    return series[0].real, 2 * series[1 : HARMONICS + 1]


def swing(model: Model, leg: Leg, seed: int) -> Motion:
    """Return the joints' motion in strides at running speed."""
    series = stride(model, leg, centres(model, seed, amplitude=0.0)[0])
    times = np.arange(0.0, (SETTLE + COUNTED) / leg.frequency, HOLD)
    return Motion(*series_of(series, leg.frequency, times))


def series_of(series: Series, frequency: float, times: Array) -> tuple[Array, Array, Array]:
    """Return a Fourier series, as `stride` gives it, and its two derivatives, each of shape (n_times, n_poses, nq)."""
    mean, harmonics = series
    w = 2j * np.pi * frequency * np.arange(1, len(harmonics) + 1)
    waves = np.exp(times[:, None] * w)
    x, xd, xdd = (np.einsum("th,h,hpq->tpq", waves, w**order, harmonics).real for order in range(3))
    return x + mean, xd, xdd


def of_foot(model: Model, motion: Motion) -> Motion:
    """Return the motion of the foot in a motion of the joints."""
    x, xd = model.contact_points(motion.x, motion.xd)
    return Motion(x[..., 0, :], xd[..., 0, :], model.contact_accelerations(motion.x, motion.xd, motion.xdd)[..., 0, :])


def of_joints(model: Model, foot: Motion, rest: Array) -> Motion:
    """Return a motion of the joints that takes the foot along, as near to `rest` (n_poses, nq) as may be.

    Velocities and accelerations are central differences, 0.07 % off at 10 Hz.
    """
    q, guess = np.empty((len(foot.x), *rest.shape)), rest
    for i, place in enumerate(foot.x):
        guess = reach(model, place, guess, rest)
        q[i] = touch(model, place, guess)
    v = np.gradient(q, HOLD, axis=0, edge_order=2)
    return Motion(q, v, np.gradient(v, HOLD, axis=0, edge_order=2))


def held(q: Array, count: int) -> Motion:
    """Return the motion of joints that stay where they are, (n_poses, nq), at `count` times."""
    still = np.broadcast_to(np.zeros_like(q), (count, *q.shape))
    return Motion(np.broadcast_to(q, still.shape), still, still)


def foot_at(model: Model, q: Array) -> Array:
    """Return where the foot is [m], shape (..., 3)."""
    return model.contact_points(q, np.zeros_like(q))[0][..., 0, :]


def foot_jacobian(model: Model, q: Array) -> Array:
    """Return the Jacobian of the foot's place, shape (..., 3, nv)."""
    unit = np.broadcast_to(np.eye(model.nv), (*q.shape[:-1], model.nv, model.nv))
    columns = model.contact_points(np.broadcast_to(q[..., None, :], unit.shape), unit)[1][..., 0, :]
    return np.swapaxes(columns, -1, -2)


def reach(model: Model, place: Array, q: Array, rest: Array, weight: float = 1e-3, steps: int = 5) -> Array:
    """Return the poses (n, nq) near `rest` whose foot is at a place (n, 3): damped least squares, Gauss-Newton."""
    for _ in range(steps):
        J = foot_jacobian(model, q)
        JT = np.swapaxes(J, -1, -2)
        error = np.einsum("nji,nj->ni", J, place - foot_at(model, q)) + weight * (rest - q)
        q = q + np.linalg.solve(JT @ J + weight * np.eye(model.nv), error[..., None])[..., 0]
    return q


def touch(model: Model, place: Array, q: Array, steps: int = 3) -> Array:
    """Return the poses (n, nq) nearest to `q` whose foot is at a place (n, 3): Newton's method."""
    for _ in range(steps):
        error = place - foot_at(model, q)
        q = q + (np.linalg.pinv(foot_jacobian(model, q)) @ error[..., None])[..., 0]
    return q
