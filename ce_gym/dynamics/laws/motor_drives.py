"""Motors: control, limits, losses, heat, battery and sampling; `forces/actuation.py` has the equations.

The memory of motors belongs to five effects, each with fields of its own: friction that depends on the load, torque
that lags behind the command, temperature, the voltage of a battery, and the torques that a sampled controller holds.

The load of a motor is its torque, and the torque of the rest of the robot on its rotor. The rest of the robot acts on
the coordinates of a cluster with the inertia forces less the torques of the motors,

    external = D ydd - tau,    D = G^T H G of the articulated bodies beyond it, see ce_aba.py:

gravity, contacts, springs and the motion of the carrier, but not the cluster's own inertia. For a pendulum this is
gravity alone. These forces act on rotors as joint torques do. Where a transmission stretches, the load is the torque of
its mesh.

Friction under load is computed from mean loads over the last step: over the last part of a step made in parts, over
the last stage of a step made in stages, and within a step over the stage before. Refused steps leave no load. Further
iterations use the loads of the last iteration whose active set of the motors was right, because a rotor that is wrongly
assumed to stick is stopped by a large torque. The load can be late by a step, an error of first order; so methods that
extrapolate need a second iteration in every stage. Friction always removes energy, whatever its load. Where there was
no step before, rotors at rest are held in the first iteration, which gives the load.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.actuation import (
    Actuated,
    MotorState,
    actuated_clusters,
    effort_matrix,
    encoder_map,
    limit_count,
)
from ce_gym.dynamics.forces.cogging import cogging_energy
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.motor_control import MotorControl, motor_springs
from ce_gym.dynamics.forces.motors import MOTORS, lagging_motors, loaded_motors, supply_of, warm_motors
from ce_gym.dynamics.forces.saturation import ITERATIONS, SaturatedForce
from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.forces.supply import Supply, Work
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter, unit_factor
from ce_gym.dynamics.state import Field, Output, State
from ce_gym.model.description import Robot

KD_UNIT = "N m s/rad or N s/m"


def gains(robot: Robot, name: str) -> list[float]:
    """Return the gains "kp" or "kd" of all joints; 0 for joints without."""
    return [dict(getattr(robot.gains, name)).get(joint, 0.0) for joint in robot.commanded]


class MotorDrives(ForceLaw):
    """All motors of a robot and the controllers that command them."""

    parameters = (
        Parameter(
            "kp", "position gains of the joints", "N m/rad or N/m", "n_joints", lambda robot, _: gains(robot, "kp")
        ),
        Parameter("kd", "velocity gains of the joints", KD_UNIT, "n_joints", lambda robot, _: gains(robot, "kd")),
        Parameter("motor_strength", "factor on motor torques and their limits", "-", "1", unit_factor),
    )
    outputs = (
        Output("torque", "N m or N", "motor torque at each joint", "mean"),
        Output("motor_torque", "N m", "torque of each motor's windings, before losses", "mean"),
        Output("motor_speed", "rad/s", "speed of each motor's rotor"),
        Output("power", "W", "mechanical power of the motors at each joint"),
        Output("winding_temperature", "deg C", "temperature of the winding of each motor that grows warm"),
        Output("battery_voltage", "V", "voltage of the battery that feeds the motors, if there is one"),
    )

    def declare(self) -> None:
        """Remember loads, lagging torques, temperatures, the battery's voltage and sampled torques."""
        robot, model, options = self.mechanism.robot, self.options.motors, self.options
        joints, motors = len(robot.commanded), len(robot.motors)
        loaded, warm = len(loaded_motors(robot, model)), len(warm_motors(robot, model))
        battery = int(robot.battery is not None and MOTORS[model].at_motors)
        load = 2 * loaded + 1 if loaded else 0
        held = len(target_names(self.mechanism, options.control)) + 1 if options.sampled else 0
        self.fields = (
            Field("motor_load", load, "N m", LOAD, explicit=True),
            Field("lagging_torque", len(lagging_motors(robot, model)), "N m", LAG),
            Field("motor_warmth", 2 * warm, "K", WARMTH),
            Field("battery_sag", battery, "V", SAG),
            Field("held_torque", held, "N m or N; last s", HELD),
        )
        self.output_sizes = {"torque": joints, "motor_torque": motors, "motor_speed": motors, "power": joints}
        self.output_sizes |= {"winding_temperature": warm, "battery_voltage": battery}
        limits = limit_count(self.mechanism, options)
        self.size, self.iterations = limits + load, ITERATIONS if limits else 0

    def place(self, start: Start) -> PlacedMotors:
        """Return the motors at the start of a step."""
        return PlacedMotors(start)

    def energy(self, start: Start) -> SX:
        """Return the energy of cogging, and of position control as if motors had no limits [J]."""
        scene, total, options = start.scene, SX(0), self.options
        if options.control == "position":
            at = encoder_map(scene.mechanism, start.kinematics) @ start.y
            others = dict(options.joint_control)
            held = [i for i, name in enumerate(scene.mechanism.robot.commanded) if name not in others]
            springs = scene.values["kp"][held] * (start.target - at)[held] ** 2
            total += ca.sum1(scene.values["motor_strength"] * springs) / 2
        if options.control == "motor_position":
            stiffness, stretch = motor_springs(scene, start.kinematics, start.y, start.target)
            total += ca.sum1(scene.values["motor_strength"] * stiffness * stretch**2) / 2
        if MOTORS[options.motors].at_motors:
            for cluster in actuated_clusters(scene.mechanism, start.kinematics):
                for i, motor in enumerate(cluster.motors):
                    total += cogging_energy(motor.cogging, cluster.angles[i])
        return total


LOAD = "torque of each motor with load-dependent friction, torque of all else on its rotor, then 1; zeros after a reset"
LAG = "torque of each motor with a finite bandwidth at the end of the last step"
WARMTH = "temperature above the air of each winding, then of each housing"
SAG = "difference of the battery's voltage from that without load"
HELD = "torques that a sampled controller holds, then the time until its next sample"


@dataclass
class PlacedMotors(PlacedForce):
    """The motors at the start of a step."""

    start: Start

    def linearise(self, iterate: SX) -> MotorForces:
        """Linearise about an iterate."""
        start, scene, load = self.start, self.start.scene, self.start.state["motor_load"]
        limits = iterate.numel() - load.numel()
        if load.numel():
            load = ca.if_else(iterate[-1] > 0, iterate[limits:], load)
        before = MotorState.of(scene.mechanism, scene.options, load, start.state)
        motors = MotorControl(scene, start.kinematics, start.y, start.yd, start.target, start.dt, before)
        return MotorForces(start, motors.linearise(iterate[:limits]), load, iterate[limits:])


@dataclass
class MotorForces(LinearForce):
    """The torques of motors at the joints, linear in the accelerations.

    Attributes:
        start: The robot at the start of the step.
        force: On the joints.
        load: What friction under load is computed from, as the field `motor_load`.
        iterate: Of the iteration before; zero in the first iteration.
    """

    start: Start
    force: SaturatedForce
    load: SX
    iterate: SX

    def __post_init__(self) -> None:
        self.sticks = self.force.frictions

    def add_to(self, loads: Loads) -> None:
        """Add the torques to the joints."""
        loads.joints = loads.joints + self.force

    def check(self, motion: Motion) -> SX:
        """Return 1 if a torque is beyond a limit that was not assumed, or its load is not known yet; else 0."""
        changed = self.force.check(motion)
        if self.load.numel():  # extrapolation needs loads of the same step in all of its stages
            extrapolates = METHODS[self.start.scene.options.method].estimates
            changed = ca.logic_or(changed, (self.iterate if extrapolates else self.load)[-1] < 0.5)
        return changed

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return expected torques and loads; loads only of iterations in which no torque was at a wrong limit."""
        sound = ca.logic_and(unconverged, ca.logic_not(self.force.check(motion)))
        load = ca.if_else(sound, self._load_after(motion), self.load) if self.load.numel() else self.load
        return ca.vertcat(self.force.next_iterate(motion), load)

    def advance(self, motion: Motion) -> dict[str, SX]:
        """Return the memory of all effects at the end of the step."""
        start, scene, robot = self.start, self.start.scene, self.start.scene.mechanism.robot
        warmth, sag = SX(0, 1), SX(0, 1)
        if start.state["motor_warmth"].numel() or start.state["battery_sag"].numel():
            supply = supply_of(robot, scene.options.motors, start.state)
            warmth, sag = supply.after(robot.motors, self._work(supply, motion), start.dt)
        lagging = lagging_motors(robot, scene.options.motors)
        return {
            "motor_load": self._load_after(motion),
            "lagging_torque": ca.vertcat(SX(0, 1), *[self.force.windings[i].at(motion.ydd) for i in lagging]),
            "motor_warmth": warmth,
            "battery_sag": sag,
            "held_torque": self.force.sampled,
        }

    def _work(self, supply: Supply, motion: Motion) -> dict[int, Work]:
        """Return the work of each motor over the step, by its place."""
        start, work = self.start, {}
        yd, strength = start.yd + start.dt * motion.ydd, start.scene.values["motor_strength"]
        for cluster in actuated_clusters(start.scene.mechanism, start.kinematics):
            speed = cluster.W @ yd[cluster.rows]
            for i, (place, motor) in enumerate(zip(cluster.places, cluster.motors, strict=True)):
                torque, full = self.force.windings[place].at(motion.ydd), strength * supply.line(place, motor)
                work[place] = Work(torque, speed[i], self.force.on_line.get(place, SX(0)) * full)
        return work

    def _load_after(self, motion: Motion) -> SX:
        """Return the field `motor_load` after the step; as it was if the inertias of the recursion are unknown."""
        scene, articulation = self.start.scene, motion.articulation
        if articulation is None:
            return self.load
        places = loaded_motors(scene.mechanism.robot, scene.options.motors)
        torques, loads = SX(len(places), 1), SX(len(places), 1)
        for cluster in actuated_clusters(scene.mechanism, self.start.kinematics) if places else ():
            external = self._external(cluster, articulation.inertia[cluster.index], motion)
            for i, place in enumerate(cluster.places):
                if place in places:
                    torques[places.index(place)] = self.force.windings[place].at(motion.ydd)
                    loads[places.index(place)] = external[i]
        return ca.vertcat(torques, loads, 1) if places else SX(0, 1)

    def _external(self, cluster: Actuated, inertia: SX, motion: Motion) -> SX:
        """Return the torques of the rest of the robot on the rotors of a cluster [N m], shape (n_motors,).

        Args:
            cluster: The cluster.
            inertia: Of the cluster, without what acts on its coordinates, shape (d, d).
            motion: The acceleration.
        """
        rows, d = cluster.rows, len(cluster.joints)
        ydd = motion.ydd[rows]
        on_rows = inertia @ ydd - (self.force.tau[rows] - self.force.slope[rows, rows] @ ydd)
        on_motors = effort_matrix(cluster.W[:, :d]) @ on_rows[:d]
        for i in range(len(cluster.motors)):
            stretch = ca.sparsify(cluster.W[i, d:])
            for column in stretch.sparsity().get_col():
                on_motors[i] = on_rows[d + column] / stretch[column]
        return on_motors

    def output(self, name: str, motion: Motion, after: State) -> SX:
        """Return an output of the motors, given the state at the end of the step."""
        mechanism, kinematics = self.start.scene.mechanism, self.start.kinematics
        yd, robot = after.v[mechanism.robot.layout.joints_v :], mechanism.robot
        torque = self.force.at(motion.ydd)[: len(robot.commanded)]
        if name == "motor_speed":
            return ca.vertcat(SX(0, 1), *[c.W @ yd[c.rows] for c in actuated_clusters(mechanism, kinematics)])
        if name == "motor_torque":
            return self._winding_torques(torque, motion)
        if name == "power":
            return torque * (encoder_map(mechanism, kinematics) @ yd)
        if name in ("winding_temperature", "battery_voltage"):
            supply = supply_of(robot, self.start.scene.options.motors, after)
            return (
                supply.voltage
                if name == "battery_voltage"
                else ca.vertcat(SX(0, 1), *supply.temperatures(robot.motors))
            )
        return torque

    def _winding_torques(self, torque: SX, motion: Motion) -> SX:
        """Return the torque of each motor [N m], shape (n_motors,); of ideal motors the share of the joint torque."""
        mechanism = self.start.scene.mechanism
        torques = SX(len(mechanism.robot.motors), 1)
        for cluster in actuated_clusters(mechanism, self.start.kinematics):
            shares = effort_matrix(cluster.W[:, : len(cluster.joints)]) @ torque[cluster.joints]
            for i, place in enumerate(cluster.places):
                winding = self.force.windings.get(place)
                torques[place] = shares[i] if winding is None else winding.at(motion.ydd)
        return torques
