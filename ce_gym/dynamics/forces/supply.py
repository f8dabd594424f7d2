"""Temperatures and supply voltage of motors: how they limit torques, and how a step changes them.

*Heat.* A motor has two masses, winding and housing, that its losses heat and the air cools:

    C_w dw/dt = (tau / K)^2 R(w) - (w - h) / R_wh        C_h dh/dt = (w - h) / R_wh - h / R_ha

with w and h above the air, K the motor constant and R the winding's resistance over that at 20 deg C, which rises with
the winding. The model is the one of data sheets (maxon, "Technology - short and to the point", chapter 7). Its step is
linearly implicit and cannot overshoot. The implicit rise of R has a pole where `dt (tau / K)^2 dR/dw = C_w`, so it is
limited to half of C_w, and the loss of a step to `LARGEST_RISE`. The step of the temperatures follows the step of the
mechanics and uses its torque, because temperatures hardly change in a sub-step. It costs some twenty instructions for
each motor.

*Voltage.* A battery feeds all motors, behind a resistance:

    V = V_0 - R I(V),    I = (P + idle) / V,    P = sum of tau omega + (tau / K)^2 R_w over the motors

V limits torques, and torques draw I within the same step. So V is a state, and each step makes one Newton iteration on
this circuit at the speeds of the end of the step. The iteration includes the derivative of the torques on torque-speed
lines with respect to V. Without it, V would oscillate where motors draw more than the battery can give.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.model.drives import Battery, Heat, Motor

COPPER = 3.93e-3
"""How the resistance of copper rises, as a share of that at `REFERENCE` [1/K] (IEC 60028)."""
REFERENCE = 20.0
"""Temperature at which motor constants are what they are [deg C]."""
LARGEST_RISE = 500.0
"""Largest rise of a winding by its loss in a step, were its resistance constant: far beyond any real motor [K]."""
LEAST = 0.5
"""Share of the voltage without load at which a battery gives its largest power."""
GENTLE = 0.2
"""Least slope of the circuit's equation; near the most that a battery can give it vanishes."""


@dataclass(frozen=True)
class Work:
    """Torque and speed of a motor over a step.

    Attributes:
        torque: Of the winding, at the end of the step [N m].
        speed: Of the rotor, at the end of the step [rad/s].
        answer: Derivative of the torque with respect to the share of the nominal voltage, at that speed [N m]: `stall`
            on the torque-speed line forwards, `-stall` on the line backwards, else 0.
    """

    torque: SX
    speed: SX
    answer: SX


@dataclass(frozen=True)
class Supply:
    """Temperatures of motors and the voltage that feeds them.

    Attributes:
        windings: Temperatures of windings above the air, by the places of the motors that grow warm [K].
        housings: Temperatures of housings above the air, by the same places [K].
        battery: The battery; None for a constant voltage.
        sag: Difference of the battery's voltage from its voltage without load [V].
    """

    windings: Mapping[int, SX]
    housings: Mapping[int, SX]
    battery: Battery | None
    sag: SX

    @property
    def voltage(self) -> SX:
        """Voltage of the battery [V]; no entries without a battery."""
        return SX(0, 1) if self.battery is None else SX(self.battery.voltage - self.sag)

    def temperatures(self, motors: tuple[Motor, ...]) -> list[SX]:
        """Return temperatures of the windings of those motors that grow warm [deg C]."""
        return [motors[i].heat.ambient + rise for i, rise in self.windings.items()]  # type: ignore[union-attr]

    def now(self, place: int, motor: Motor) -> Motor:
        """Return a motor with the limits that current and voltage leave it."""
        figures: dict[str, Any] = {}
        if self.battery is not None:
            share = self.voltage / self.battery.nominal
            figures = {"stall": share * self.line(place, motor), "velocity": share * motor.velocity}
        if place in self.windings:
            assert motor.heat is not None
            figures.setdefault("stall", self.line(place, motor))
            figures["torque"] = allowed(motor.heat, self.windings[place]) * motor.torque
        return replace(motor, **figures) if figures else motor

    def line(self, place: int, motor: Motor) -> SX | float:
        """Return the torque of a motor at standstill and nominal voltage [N m]; warm windings give less."""
        if place not in self.windings or motor.heat is None:
            return motor.line
        return motor.line / resistance(motor.heat, self.windings[place])

    def after(self, motors: tuple[Motor, ...], work: Mapping[int, Work], dt: SX | float) -> tuple[SX, SX]:
        """Return temperatures of windings, then housings, above the air [K], and the sag [V], after a step."""
        warmth = [
            warmed(motors[i], motors[i].heat, self.windings[i], self.housings[i], work[i].torque, dt)  # type: ignore[arg-type]
            for i in self.windings
        ]
        rises = [winding for winding, _ in warmth] + [housing for _, housing in warmth]
        sag = SX(0, 1) if self.battery is None else self._sag_after(self.battery, motors, work)
        return ca.vertcat(SX(0, 1), *rises), sag

    def _sag_after(self, battery: Battery, motors: tuple[Motor, ...], work: Mapping[int, Work]) -> SX:
        power, answer = SX(0), SX(0)
        for place, done in work.items():
            motor, warmth = motors[place], SX(1)
            if place in self.windings:
                warmth = resistance(motor.heat, self.windings[place])  # type: ignore[arg-type]
            loss = copper_loss(motor, done.torque) * warmth
            power += done.torque * done.speed + loss
            per_torque = done.speed + 2 * warmth * done.torque / motor.motor_constant**2  # type: ignore[operator]
            answer += per_torque * done.answer / battery.nominal
        return sagged(battery, self.sag, power, answer)


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
    across, per_kelvin = flow * (winding - housing), heat.winding_capacity / SX(dt)
    heating = ca.fmin(loss * resistance(heat, winding), LARGEST_RISE * per_kelvin)
    growth = ca.fmin(COPPER * loss, per_kelvin / 2)
    into_winding, into_housing = dt * (heating - across), dt * (across - out * housing)
    to_air, between = heat.housing_capacity + dt * out, dt * flow
    alone = heat.winding_capacity - dt * growth
    of_winding, of_housing = alone + between, to_air + between
    scale = 1 / (alone * of_housing + between * to_air)
    rise = scale * (of_housing * into_winding + between * into_housing)
    return winding + rise, housing + scale * (between * into_winding + of_winding * into_housing)


def copper_loss(motor: Motor, torque: SX) -> SX:
    """Return the loss of a winding at 20 deg C for a torque [W]."""
    assert motor.motor_constant is not None
    return (torque / motor.motor_constant) ** 2


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
