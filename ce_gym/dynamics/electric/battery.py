"""Voltage of a battery that feeds all motors: what is left of it behind a resistance.

    V = V_0 - R I(V),    I = (P + idle) / V,    P = sum of tau omega + (tau / K)^2 R_w over the motors

V limits torques and they draw I, within one step: so V is a state, and a step of it one of Newton's method on this
circuit at the speeds of the end of the step. It counts how the torques on their torque-speed lines answer to V. Without
that, V would swing from step to step wherever motors together draw more than the battery can give.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model.drives import Battery

LEAST = 0.5
"""Of the voltage without load: where a battery gives the most it can; below, more current is less power."""
GENTLE = 0.2
"""Least slope of the circuit's equation; near the most that a battery can give it vanishes."""


def sagged(battery: Battery, sag: SX, power: SX, answer: SX) -> SX:
    """Return how far the voltage is below that without load after a step [V].

    Args:
        battery: The battery.
        sag: The same before [V].
        power: What the motors draw [W].
        answer: How that rises with the voltage, by motors on their torque-speed lines [W/V].
    """
    voltage = battery.voltage - sag
    current = (power + battery.idle) / voltage
    slope = 1 + battery.resistance * (answer - current) / voltage
    after = sag + (battery.resistance * current - sag) / ca.fmax(slope, GENTLE)
    return ca.fmin(after, LEAST * battery.voltage)
