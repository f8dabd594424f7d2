"""What drives joints: motors, what they lose, what feeds them, transmissions that give way; figures are the rotor's."""

from __future__ import annotations

from dataclasses import dataclass

ELASTIC_FACTORS = "drive_stiffness", "drive_damping", "backlash"
"""What each elastic transmission can have a factor on, and all of them together."""


@dataclass(frozen=True)
class DriveFriction:
    """How much more dry friction a drive has at rest and under load. All figures are the rotor's.

    With `tau_m` the torque of the motor, `tau_e` what all else does to the rotor, of opposite signs where it has to
    carry something, and `s = exp(-|speed / stribeck_speed|^stribeck_exponent)`, its dry friction is at most
    `friction + factor (|load_motor tau_m - load_external tau_e| + E + s (stribeck + S + Q))`, where
    `S = |stribeck_load_motor tau_m - stribeck_load_external tau_e|`.

    If they are of opposite signs and the motor drives, `|tau_m| > |tau_e|`, it is `Q = stribeck_square_external
    tau_e^2` and `E = (1 / efficiency - 1) |tau_e|`; if it is driven back, `Q = stribeck_square_motor tau_m^2` and `E =
    (1 - backdriving_efficiency) |tau_e|`. Without E these are the models M2 to M6 of Duclusaud, Passault, Padois
    and Ly, "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025 (arXiv:2410.08650).

    Attributes:
        stribeck: What is added at rest [N m].
        stribeck_speed: Speed at which that has fallen to 37 % [rad/s].
        stribeck_exponent: How abruptly it falls; 2 for a Gaussian.
        load_motor: Share of the motor's torque [-].
        load_external: Share of what all else does [-].
        stribeck_load_motor: The same of what is added at rest [-].
        stribeck_load_external: The same [-].
        stribeck_square_motor: Share of the square in what is added at rest [1/(N m)].
        stribeck_square_external: The same [1/(N m)].
        efficiency: Share of the motor's torque that moves a load at a steady speed, without all the above [-].
        backdriving_efficiency: Share of a load that reaches the motor as it is driven back; 0 for self-locking [-].
        factor: On all of this [-].
    """

    stribeck: float = 0.0
    stribeck_speed: float = float("inf")
    stribeck_exponent: float = 2.0
    load_motor: float = 0.0
    load_external: float = 0.0
    stribeck_load_motor: float = 0.0
    stribeck_load_external: float = 0.0
    stribeck_square_motor: float = 0.0
    stribeck_square_external: float = 0.0
    efficiency: float = 1.0
    backdriving_efficiency: float = 1.0
    factor: float = 1.0

    @property
    def shares(self) -> tuple[float, ...]:
        """What multiplies torques, or squares of them; none of it is negative."""
        of_speed = self.stribeck_load_motor, self.stribeck_load_external
        squares = self.stribeck_square_motor, self.stribeck_square_external
        return self.load_motor, self.load_external, *of_speed, *squares

    @property
    def loaded(self) -> bool:
        """Whether it depends on torques."""
        return any(self.shares) or self.efficiency < 1 or self.backdriving_efficiency < 1


@dataclass(frozen=True)
class Heat:
    """How a motor grows warm: its losses heat the winding, the winding the housing, and the housing the air.

    From `warm` on the largest torque falls with the winding's temperature, to none at `hot`, as drives protect motors.

    Attributes:
        winding_capacity: Heat capacity of the winding [J/K].
        housing_capacity: Of the housing [J/K].
        winding_to_housing: Thermal resistance [K/W].
        housing_to_ambient: The same [K/W].
        warm: Temperature of the winding from which torque is held back [deg C].
        hot: Where none is left [deg C].
        ambient: Temperature of the air, and of a motor that has rested [deg C].
    """

    winding_capacity: float
    housing_capacity: float
    winding_to_housing: float
    housing_to_ambient: float
    warm: float = 100.0
    hot: float = 125.0
    ambient: float = 25.0


@dataclass(frozen=True)
class Battery:
    """What feeds all motors: a voltage behind a resistance. What flows back charges it.

    Attributes:
        voltage: Without load [V].
        resistance: Of cells and wires [ohm].
        nominal: At which the motors' torque-speed lines are what their figures say [V].
        idle: What everything but the motors takes [W].
    """

    voltage: float
    resistance: float
    nominal: float
    idle: float = 0.0


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
        drive_friction: What depends on speed and load besides; None for nothing.
        bandwidth: Of the loop that follows the torque it is asked for, a lag of first order [Hz].
        motor_constant: Torque over the root of what the winding then loses, at 20 deg C [N m/sqrt(W)]; None if unknown.
        heat: How it grows warm; None if it never does.
        cogging: Harmonics of the torque of its magnets on its teeth, `-torque sin(order angle + phase)`: triples of
            order in a turn of the rotor, torque [N m] and phase [rad].
    """

    rotor: str
    torque: float = float("inf")
    velocity: float = float("inf")
    stall: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    drive_friction: DriveFriction | None = None
    bandwidth: float = float("inf")
    motor_constant: float | None = None
    heat: Heat | None = None
    cogging: tuple[tuple[int, float, float], ...] = ()

    @property
    def line(self) -> float:
        """Torque at standstill, as the voltage allows [N m]."""
        return self.torque if self.stall is None else self.stall


def stretch_of(rotor: str) -> str:
    """Return the name of the coordinate by which the transmission of a rotor stretches, if it is elastic."""
    return f"{rotor}_stretch"


@dataclass(frozen=True)
class Elasticity:
    """How the transmission of a rotor gives way: gear mesh, belt or series spring. All figures are the rotor's.

    The stretch is how far the rotor is ahead of where the joints that it drives would have it. What a data sheet says
    of the output is divided by the square of the gear ratio if it is a stiffness, multiplied by the ratio if an angle.

    Attributes:
        rotor: Name of the rotor body.
        stiffness: [N m/rad].
        damping: [N m s/rad].
        backlash: Play: how far the rotor turns from one flank to the other, the joints held [rad].
        preload: Of a belt: the torque at which one of its strands goes slack, beyond which it is half as stiff [N m];
            infinite for what pulls and pushes alike.
        play: Factor on the backlash [-]; with a backlash of 0 there are no flanks, whatever it is.
    """

    rotor: str
    stiffness: float
    damping: float = 0.0
    backlash: float = 0.0
    preload: float = float("inf")
    play: float = 1.0

    @property
    def stretch(self) -> str:
        """Name of its coordinate."""
        return stretch_of(self.rotor)

    @property
    def linear(self) -> bool:
        """Whether its torque is proportional to the stretch."""
        return not self.backlash and self.preload == float("inf")
