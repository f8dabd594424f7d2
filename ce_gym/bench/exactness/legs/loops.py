"""Closed loops: a controller that knows a leg at one level, on an exact plant, read and held every millisecond."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ce_gym.bench.exactness.legs import signals
from ce_gym.bench.exactness.legs.control import ALONG, Controllers
from ce_gym.bench.exactness.legs.signals import Motion
from ce_gym.bench.exactness.mechanisms import leg_on_stand, without_limits
from ce_gym.bench.exactness.protocol import BANDWIDTHS, COUNTED, HOLD, PLANT_STEP, POSES, SETTLE, SLOWEST, Array, Leg
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim.simulator import Simulator
from ce_gym.viewer.console import shown


@dataclass(frozen=True)
class Task:
    """A motion to follow with a kind of controller.

    Attributes:
        controller: "joints", "foot" or "foot, posture along".
        signal: "chirp" or "swing".
        motion: Of the joints or of the foot.
        start: State at the beginning, q and v, each of shape (n_poses, nq).
        posture: Of the joints in the null space of the foot.
        band: Which band every sample is counted in, -1 for none, shape (n_times,).
        frequencies: Of the bands [Hz].
    """

    controller: str
    signal: str
    motion: Motion
    start: tuple[Array, Array]
    posture: Motion
    band: Array
    frequencies: tuple[float, ...]


@dataclass(frozen=True)
class Tracked:
    """Root mean squares over a band, each of shape (n_bands, n_levels, n_bandwidths, n_poses).

    Attributes:
        error: Of a joint, mean square over them [rad], or of the foot [m].
        torque_error: Of a joint's torque against an exact controller's in the same state [N m].
        torque: Of that exact torque [N m].
    """

    error: Array
    torque_error: Array
    torque: Array


def tasks(leg: Leg, seed: int) -> Iterator[Task]:
    """Yield the six tasks of a leg."""
    yield from chirps(leg, seed)
    yield from swings(leg, seed)


def chirps(leg: Leg, seed: int) -> Iterator[Task]:
    """Yield the chirps of the joints, and of the foot with a posture at rest and with one that goes along."""
    model = Model(leg_on_stand(leg))
    joints, (foot, rest) = signals.joint_chirp(model, seed), signals.foot_chirp(model, seed)
    _, frequency = signals.chirp_times()
    band = np.floor(frequency - SLOWEST).astype(int)
    bands = tuple(SLOWEST + 0.5 + i for i in range(band.max() + 1))
    still = signals.held(rest, len(band))
    yield Task("joints", "chirp", joints, _start(joints), still, band, bands)
    push = np.linalg.pinv(signals.foot_jacobian(model, rest)) @ foot.xd[0][..., None]
    yield Task("foot", "chirp", foot, (rest, push[..., 0]), still, band, bands)
    along = signals.of_joints(model, foot, rest)
    yield Task(ALONG, "chirp", foot, _start(along), along, band, bands)


def swings(leg: Leg, seed: int) -> Iterator[Task]:
    """Yield the swing leg as a motion of the joints, and of the foot with either posture."""
    model = Model(leg_on_stand(leg))
    running, (pose, _) = signals.swing(model, leg, seed), signals.centres(model, seed, amplitude=0.0)
    settling = np.arange(len(running.x)) < len(running.x) * SETTLE / (SETTLE + COUNTED)
    counted, stride = np.where(settling, -1, 0), (leg.frequency,)
    standing, stepping = signals.held(pose, len(counted)), signals.of_foot(model, running)
    yield Task("joints", "swing", running, _start(running), standing, counted, stride)
    yield Task("foot", "swing", stepping, _start(running), standing, counted, stride)
    yield Task(ALONG, "swing", stepping, _start(running), running, counted, stride)


def _start(joints: Motion) -> tuple[Array, Array]:
    return joints.x[0], joints.xd[0]


def follow(
    leg: Leg,
    task: Task,
    levels: tuple[str, ...] = LEVELS,
    bandwidths: tuple[float, ...] = BANDWIDTHS,
    samples: int | None = None,
) -> Tracked:
    """Follow a motion with controllers of all levels and bandwidths [Hz], from all poses at the same time."""
    robot = without_limits(leg_on_stand(leg))
    exact, shape = Model(robot), (len(levels), len(bandwidths), POSES)
    count, per_level = int(np.prod(shape)), int(np.prod(shape[1:]))
    plant = Simulator(exact, count, PLANT_STEP, control="torque", contacts=(), outputs=(), method="rk4")
    plant.set_state(*(np.broadcast_to(x, (*shape, exact.nv)).reshape(count, -1) for x in task.start))
    controllers = Controllers(exact, [Model(robot, level) for level in levels], task.controller, per_level)
    w = np.repeat(2 * np.pi * np.array(bandwidths), POSES)[:, None]
    times = range(len(task.band) if samples is None else samples)
    sums, counts = np.zeros((3, len(task.frequencies), *shape)), np.zeros(len(task.frequencies))
    for i in shown(times, f"{leg.robot} {task.controller} {task.signal}"):
        q, v = (x.reshape(len(levels), per_level, -1) for x in (plant.q, plant.v))
        aim, posture = (_tiled(motion, i, len(bandwidths)) for motion in (task.motion, task.posture))
        torque, ideal = controllers(q, v, *aim, *posture, w)
        if task.band[i] >= 0:
            foot = task.controller != "joints"
            place = signals.foot_at(exact, q) if foot else q
            error = ((place - aim[0]) ** 2).sum(-1) / (1 if foot else exact.nv)
            squares = error, ((torque - ideal) ** 2).mean(-1), (ideal**2).mean(-1)
            sums[:, task.band[i]] += np.reshape(squares, (3, *shape))
            counts[task.band[i]] += 1
        plant.step(torque.reshape(count, -1), round(HOLD / PLANT_STEP))
    return Tracked(*np.sqrt(sums / np.maximum(counts, 1)[:, None, None, None]))


def _tiled(motion: Motion, i: int, times: int) -> list[Array]:
    return [np.tile(x[i], (times, 1)) for x in (motion.x, motion.xd, motion.xdd)]
