"""Temperatures and supply voltage of motors: how they limit torques, and how a step changes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.electric.battery import sagged
from ce_gym.dynamics.electric.heat import allowed, copper_loss, resistance, warmed
from ce_gym.model.drives import Battery, Motor


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
