"""Drives: motors, their friction and heat, the battery, and elastic transmissions; all values are at the rotor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ce_gym.model.ranges import (
    HeatCapacity,
    NotNegative,
    NotNegativeOrInfinite,
    Positive,
    PositiveOrInfinite,
    PositiveShare,
    Share,
    Temperature,
    ThermalResistance,
)

ELASTIC_FACTORS = "drive_stiffness", "drive_damping", "backlash"
"""Parameters that scale one elastic transmission, or all elastic transmissions."""


@dataclass(frozen=True)
class DriveFriction:
    """Dry friction of a drive that depends on speed and load, at the rotor.

    `tau_m` is the motor's torque and `tau_e` the external torque on the rotor; the signs are opposite if the motor
    carries a load. With `s = exp(-|speed / stribeck_speed|^stribeck_exponent)`, dry friction is at most
    `friction + factor (|load_motor tau_m - load_external tau_e| + E + s (stribeck + S + Q))`, where
    `S = |stribeck_load_motor tau_m - stribeck_load_external tau_e|`.

    `Q` and `E` act if the signs are opposite. If the motor drives the load, `|tau_m| > |tau_e|`, then
    `Q = stribeck_square_external tau_e^2` and `E = (1 / efficiency - 1) |tau_e|`. If the load drives the motor back,
    `Q = stribeck_square_motor tau_m^2` and `E = (1 - backdriving_efficiency) |tau_e|`.

    Without E these are the models M2 to M6 of Duclusaud, Passault, Padois and Ly, "Extended Friction Models for the
    Physics Simulation of Servo Actuators", ICRA 2025 (arXiv:2410.08650).

    Attributes:
        stribeck: Additional friction at rest [N m].
        stribeck_speed: Speed at which the additional friction has fallen to 37 % [rad/s].
        stribeck_exponent: Exponent of the decay; 2 for a Gaussian.
        load_motor: Friction per motor torque [-].
        load_external: Friction per external torque [-].
        stribeck_load_motor: Additional friction at rest per motor torque [-].
        stribeck_load_external: Additional friction at rest per external torque [-].
        stribeck_square_motor: Additional friction at rest per square of the motor torque [1/(N m)].
        stribeck_square_external: Additional friction at rest per square of the external torque [1/(N m)].
        efficiency: Share of the motor's torque that moves a load at a steady speed, without the terms above [-].
        backdriving_efficiency: Share of a load that reaches the motor when driven back; 0 for self-locking [-].
        factor: Factor on all terms [-].
    """

    stribeck: Annotated[NotNegative, "N m"] = 0.0
    stribeck_speed: Annotated[PositiveOrInfinite, "rad/s"] = float("inf")
    stribeck_exponent: Annotated[PositiveOrInfinite, "-"] = 2.0
    load_motor: Annotated[NotNegative, "-"] = 0.0
    load_external: Annotated[NotNegative, "-"] = 0.0
    stribeck_load_motor: Annotated[NotNegative, "-"] = 0.0
    stribeck_load_external: Annotated[NotNegative, "-"] = 0.0
    stribeck_square_motor: Annotated[NotNegative, "1/(N m)"] = 0.0
    stribeck_square_external: Annotated[NotNegative, "1/(N m)"] = 0.0
    efficiency: Annotated[PositiveShare, "-"] = 1.0
    backdriving_efficiency: Annotated[Share, "-"] = 1.0
    factor: Annotated[NotNegative, "-"] = 1.0

    @property
    def shares(self) -> tuple[float, ...]:
        """Coefficients of torques and of squared torques, all 0 or more."""
        at_rest = self.stribeck_load_motor, self.stribeck_load_external
        squares = self.stribeck_square_motor, self.stribeck_square_external
        return self.load_motor, self.load_external, *at_rest, *squares

    @property
    def loaded(self) -> bool:
        """Whether friction depends on torques."""
        return any(self.shares) or self.efficiency < 1 or self.backdriving_efficiency < 1


@dataclass(frozen=True)
class Heat:
    """Thermal model of a motor: losses heat the winding, the winding heats the housing, and the housing the air.

    The torque limit falls linearly from its full value at winding temperature `warm` to 0 at `hot`.

    Attributes:
        winding_capacity: Heat capacity of the winding [J/K].
        housing_capacity: Heat capacity of the housing [J/K].
        winding_to_housing: Thermal resistance between winding and housing [K/W].
        housing_to_ambient: Thermal resistance between housing and air [K/W].
        warm: Winding temperature above which the torque limit falls [deg C].
        hot: Winding temperature at which the torque limit is 0 [deg C].
        ambient: Temperature of the air, and of a motor after a long rest [deg C].
    """

    winding_capacity: HeatCapacity
    housing_capacity: HeatCapacity
    winding_to_housing: ThermalResistance
    housing_to_ambient: ThermalResistance
    warm: Temperature = 100.0
    hot: Temperature = 125.0
    ambient: Temperature = 25.0


@dataclass(frozen=True)
class Battery:
    """The battery of all motors: a voltage behind a resistance. Braking motors charge it.

    Attributes:
        voltage: Voltage without load [V].
        resistance: Resistance of cells and wires [ohm].
        nominal: Voltage of the motors' torque-speed lines [V].
        idle: Power of all consumers but the motors [W].
    """

    voltage: Annotated[Positive, "V"]
    resistance: Annotated[NotNegative, "ohm"]
    nominal: Annotated[Positive, "V"]
    idle: Annotated[NotNegative, "W"] = 0.0


@dataclass(frozen=True)
class Motor:
    """An electric motor that turns a rotor.

    Attributes:
        rotor: Name of the rotor body.
        torque: Largest torque at the rotor, as the current allows [N m].
        velocity: No-load speed of the rotor [rad/s].
        stall: Torque at standstill, as the voltage allows, where the torque-speed line starts [N m]; `torque` if None.
        damping: Viscous friction of the rotor [N m s/rad].
        friction: Dry friction of the rotor [N m].
        drive_friction: Additional friction that depends on speed and load; None without.
        bandwidth: Bandwidth of the torque loop, a first-order lag between commanded and actual torque [Hz].
        motor_constant: Torque over the root of the copper loss, at 20 deg C [N m/sqrt(W)]; None if unknown.
        heat: Thermal model; None for a constant temperature.
        cogging: Harmonics of cogging torque, `-torque sin(order angle + phase)`: triples of periods in a turn of the
            rotor, torque [N m] and phase [rad].
    """

    rotor: str
    torque: Annotated[NotNegativeOrInfinite, "N m"] = float("inf")
    velocity: Annotated[PositiveOrInfinite, "rad/s"] = float("inf")
    stall: Annotated[NotNegativeOrInfinite, "N m"] | None = None
    damping: Annotated[NotNegative, "N m s/rad"] = 0.0
    friction: Annotated[NotNegative, "N m"] = 0.0
    drive_friction: DriveFriction | None = None
    bandwidth: Annotated[PositiveOrInfinite, "Hz"] = float("inf")
    motor_constant: Annotated[PositiveOrInfinite, "N m/sqrt(W)"] | None = None
    heat: Heat | None = None
    cogging: tuple[tuple[int, float, float], ...] = ()

    @property
    def line(self) -> float:
        """Torque at standstill, as the voltage allows [N m]."""
        return self.torque if self.stall is None else self.stall


def stretch_of(rotor: str) -> str:
    """Return the name of the stretch coordinate of a rotor's elastic transmission."""
    return f"{rotor}_stretch"


@dataclass(frozen=True)
class Elasticity:
    """An elastic transmission of a rotor: gear mesh, belt or series spring. All values are at the rotor.

    The stretch is `rotor angle - sum(ratio * joint angle)`. To convert a data sheet's values at the output, divide a
    stiffness by the squared gear ratio and multiply an angle by the ratio.

    Attributes:
        rotor: Name of the rotor body.
        stiffness: Stiffness [N m/rad].
        damping: Damping [N m s/rad].
        backlash: Play: angle of the rotor from one flank to the other with fixed joints [rad].
        preload: Torque at which one strand of a belt goes slack [N m]; beyond, the belt is half as stiff. Infinite for
            transmissions that pull and push equally.
        play: Factor on the backlash [-]; without effect if the backlash is 0.
    """

    rotor: str
    stiffness: Annotated[Positive, "N m/rad"]
    damping: Annotated[NotNegative, "N m s/rad"] = 0.0
    backlash: Annotated[NotNegative, "rad"] = 0.0
    preload: Annotated[PositiveOrInfinite, "N m"] = float("inf")
    play: Annotated[NotNegative, "-"] = 1.0

    @property
    def stretch(self) -> str:
        """Name of the stretch coordinate."""
        return stretch_of(self.rotor)

    @property
    def linear(self) -> bool:
        """Whether the elastic torque is proportional to the stretch."""
        return not self.backlash and self.preload == float("inf")
