"""Cogging: torque of a motor's magnets on its teeth, by the angle of its rotor, without any current.

It is that of a potential, a sum of harmonics `-(A / n) cos(n theta + phase)`, so it gives nothing over a turn. A step
takes its mean over the way that the rotor goes in it, which is what the potential falls by over that way: where a step
is longer than a tooth the mean vanishes, as cogging at speed does, instead of being any value of it. Where teeth hold
the rotor back they count by where they will be at the end of the step, twice the slope of the mean: then they never
throw it over the place where they hold it, however stiff they are.
"""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX

Harmonic = tuple[int, SX | float, float]
"""Order in a turn of the rotor, torque [N m], phase [rad]."""
NEARBY = 1e-3
"""Of half the angle that a harmonic turns by: up to here its mean goes by a series."""


def cogging(harmonics: Iterable[Harmonic], angle: SX, speed: SX, dt: SX | float) -> tuple[SX, SX]:
    """Return the mean torque over a step [N m] at zero acceleration, and how it falls with that, if it does [kg m^2].

    Args:
        harmonics: Of the motor.
        angle: Of its rotor at the start of the step [rad].
        speed: Of its rotor [rad/s].
        dt: Length of the step [s].
    """
    torque, stiffness, way = SX(0), SX(0), dt * speed
    for order, size, phase in harmonics:
        half, middle = order * way / 2, order * (angle + way / 2) + phase
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
