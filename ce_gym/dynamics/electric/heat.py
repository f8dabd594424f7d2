"""Temperature of a motor: two masses, winding and housing, that its losses heat and the air cools.

    C_w dw/dt = (tau / K)^2 R(w) - (w - h) / R_wh        C_h dh/dt = (w - h) / R_wh - h / R_ha

with w and h above the air, K the motor constant and R the winding's resistance over that at 20 deg C, which rises with
the winding. The model is the one of data sheets (maxon, "Technology - short and to the point", chapter 7). Its step is
linearly implicit and cannot overshoot. It follows the step of the mechanics and uses the torque of that step, because
temperatures hardly change in a sub-step. It costs some twenty instructions for each motor.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model.drives import Heat, Motor

COPPER = 3.93e-3
"""How the resistance of copper rises, as a share of that at `REFERENCE` [1/K] (IEC 60028)."""
REFERENCE = 20.0
"""Temperature at which motor constants are what they are [deg C]."""


def resistance(heat: Heat, winding: SX) -> SX:
    """Return a winding's resistance over that at 20 deg C [-], given how much it is warmer than the air [K]."""
    return 1 + COPPER * (heat.ambient - REFERENCE + winding)


def allowed(heat: Heat, winding: SX) -> SX:
    """Return the share of its largest torque that a motor may give [-]: 1 up to `warm`, 0 from `hot` on."""
    return ca.fmax(0, ca.fmin(1, (heat.hot - heat.ambient - winding) / (heat.hot - heat.warm)))


def warmed(motor: Motor, heat: Heat, winding: SX, housing: SX, torque: SX, dt: SX | float) -> tuple[SX, SX]:
    """Return how much winding and housing are warmer than the air after a step [K].

    Args:
        motor: The motor.
        heat: How it grows warm.
        winding: How much its winding is warmer than the air [K].
        housing: The same of its housing.
        torque: Of the winding, over the step [N m].
        dt: Length of the step [s].
    """
    loss, flow, out = copper_loss(motor, torque), 1 / heat.winding_to_housing, 1 / heat.housing_to_ambient
    across = flow * (winding - housing)
    into_winding, into_housing = dt * (loss * resistance(heat, winding) - across), dt * (across - out * housing)
    own = heat.winding_capacity + dt * (flow - COPPER * loss)
    other, between = heat.housing_capacity + dt * (flow + out), dt * flow
    scale = 1 / (own * other - between * between)
    rise = scale * (other * into_winding + between * into_housing)
    return winding + rise, housing + scale * (between * into_winding + own * into_housing)


def copper_loss(motor: Motor, torque: SX) -> SX:
    """Return the loss of a winding at 20 deg C for a torque [W]."""
    assert motor.motor_constant is not None
    return (torque / motor.motor_constant) ** 2
