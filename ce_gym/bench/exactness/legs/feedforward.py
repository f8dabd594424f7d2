"""The torque a level gets wrong along a motion without feedback: sinusoids of all joints, the paper's among them."""

from __future__ import annotations

import numpy as np

from ce_gym.bench.exactness.legs.signals import centres
from ce_gym.bench.exactness.mechanisms import leg_on_stand
from ce_gym.bench.exactness.protocol import AMPLITUDE, CORNER, FREQUENCIES, LEGS, Array, Leg
from ce_gym.bench.exactness.tables import spread
from ce_gym.bench.measure.report import Cell
from ce_gym.bench.paper import tracking
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.model.mechanism import LEVELS

COLUMNS = (
    "mechanism", "level", "frequency [Hz]", "joint", "error p5 [N m]", "error [N m]", "error p95 [N m]",
    "share p5", "share", "share p95",
)  # fmt: skip
"""Root mean square of the error, and its share of the exact torque's: percentiles 5, 50 and 95 over poses."""
SAMPLES = 200
"""Of a period."""


def rows(seed: int, frequencies: tuple[float, ...] = FREQUENCIES) -> list[tuple[Cell, ...]]:
    """Return the map: every leg, level, frequency and joint, and the paper's experiment at every frequency."""
    found = [row for name, leg in LEGS.items() for row in of_leg(name, leg, seed, frequencies)]
    return found + as_published(frequencies)


def of_leg(name: str, leg: Leg, seed: int, frequencies: tuple[float, ...]) -> list[tuple[Cell, ...]]:
    """Return the rows of one leg, all of whose joints move in phase about each of the poses."""
    models = {level: Model(leg_on_stand(leg), level) for level in LEVELS}
    exact = models["exact"]
    centre, room = centres(exact, seed)
    phase = 2 * np.pi * np.arange(SAMPLES)[:, None, None] / SAMPLES
    found = []
    for frequency in frequencies:
        size, w = room * min(1.0, CORNER / frequency), 2 * np.pi * frequency
        wave = size * np.sin(phase) + 0 * centre
        motion = centre + wave, w * size * np.cos(phase) + 0 * centre, -(w**2) * wave
        torque = exact.inverse_dynamics(*motion)
        for level in LEVELS[1:]:
            error = models[level].inverse_dynamics(*motion) - torque
            found += _rows(name, level, frequency, exact.joint_links, rms(error), rms(torque))
    return found


def as_published(frequencies: tuple[float, ...]) -> list[tuple[Cell, ...]]:
    """Return the paper's experiment: about zero, rotors deleted where they are simplified, sampled as it does."""
    robot = load_robot("mit_humanoid_leg")
    exact, found = Model(robot), []
    for frequency in frequencies:
        motion = tracking.sinusoid(exact.nv, frequency, AMPLITUDE * min(1.0, CORNER / frequency))
        torque = exact.inverse_dynamics(*motion)[:, None]
        for level in tracking.SIMPLIFIED:
            error = Model(robot, level, locked_rotors=False).inverse_dynamics(*motion)[:, None] - torque
            name = "mit_humanoid_leg, as published"
            found += _rows(name, level, frequency, exact.joint_links, rms(error), rms(torque))
    return found


def rms(x: Array) -> Array:
    """Return the root mean square over time, the first axis."""
    return np.sqrt(np.mean(x**2, axis=0))


def _rows(
    name: str, level: str, frequency: float, joints: tuple[str, ...], error: Array, torque: Array
) -> list[tuple[Cell, ...]]:
    share = error / torque
    return [
        (name, level, frequency, joint, *spread(error[:, i]), *spread(share[:, i])) for i, joint in enumerate(joints)
    ]
