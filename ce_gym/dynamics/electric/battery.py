"""Voltage of a battery that feeds all motors, behind a resistance.

    V = V_0 - R I(V),    I = (P + idle) / V,    P = sum of tau omega + (tau / K)^2 R_w over the motors

V limits torques, and torques draw I within the same step. So V is a state, and each step makes one Newton iteration on
this circuit at the speeds of the end of the step. The iteration includes the derivative of the torques on torque-speed
lines with respect to V. Without it, V would oscillate where motors draw more than the battery can give.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model.drives import Battery

LEAST = 0.5
"""Share of the voltage without load at which a battery gives its largest power."""
GENTLE = 0.2
"""Least slope of the circuit's equation; near the most that a battery can give it vanishes."""


def sagged(battery: Battery, sag: SX, power: SX, answer: SX) -> SX:
    """Return how far the voltage is below that without load after a step [V].

    Args:
        battery: The battery.
        sag: The same before [V].
        power: Power that the motors draw [W].
        answer: Derivative of this power with respect to the voltage [W/V].
    """
    voltage = battery.voltage - sag
    current = (power + battery.idle) / voltage
    slope = 1 + battery.resistance * (answer - current) / voltage
    after = sag + (battery.resistance * current - sag) / ca.fmax(slope, GENTLE)
    return ca.fmin(after, LEAST * battery.voltage)
