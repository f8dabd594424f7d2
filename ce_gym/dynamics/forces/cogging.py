"""Cogging: torque of a motor's magnets on its teeth, by the angle of its rotor, without any current.

Cogging has a potential, a sum of harmonics `-(A / n) cos(n theta + phase)`, so its mean over a turn is zero. A step
uses the mean torque over the angle that the rotor turns in it: the fall of the potential over that angle. Where a step
is longer than a tooth the mean vanishes, as cogging at speed does. Where teeth hold the rotor back, their torque is
taken at the end of the step, with twice the slope of the mean. So teeth of any stiffness never push the rotor beyond
their stable angle.
"""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX

Harmonic = tuple[int, SX | float, float]
"""Order in a turn of the rotor, torque [N m], phase [rad]."""
NEARBY = 1e-3
"""Half the angle that a harmonic turns by [rad] up to which a series gives its mean."""


def cogging(harmonics: Iterable[Harmonic], angle: SX, speed: SX, dt: SX | float) -> tuple[SX, SX]:
    """Return the mean torque over a step [N m] at zero acceleration, and how it falls with that, if it does [kg m^2].

    Args:
        harmonics: Of the motor.
        angle: Of its rotor at the start of the step [rad].
        speed: Of its rotor [rad/s].
        dt: Length of the step [s].
    """
    torque, stiffness, turn = SX(0), SX(0), dt * speed
    for order, size, phase in harmonics:
        half, middle = order * turn / 2, order * (angle + turn / 2) + phase
        share, slope = _mean(half)
        torque -= size * ca.sin(middle) * share
        stiffness += size * order * (ca.cos(middle) * share + ca.sin(middle) * slope)
    return torque, dt * dt * ca.fmax(stiffness, 0)


def cogging_energy(harmonics: Iterable[Harmonic], angle: SX) -> SX:
    """Return the potential of cogging [J] at the angle of a rotor [rad]."""
    return -sum((size / order * ca.cos(order * angle + phase) for order, size, phase in harmonics), SX(0))


def _mean(x: SX) -> tuple[SX, SX]:
    """Return `sin(x) / x` and its derivative."""
    near = ca.fabs(x) < NEARBY
    far = ca.if_else(near, 1, x)
    share = ca.if_else(near, 1 - x * x / 6, ca.sin(far) / far)
    return share, ca.if_else(near, -x / 3, (ca.cos(far) - share) / far)
