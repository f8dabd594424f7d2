"""The quantities of one robot at the end of a control step that terms read, as CasADi expressions.

A term is a function of a `TermContext`. A quantity is traced when a term reads it, and costs nothing otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, reduce

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ce_gym.compile import Grid
from ce_gym.dynamics.algebra.integration import rotation_vector
from ce_gym.dynamics.algebra.spatial import SX, quaternion_product
from ce_gym.dynamics.forces.ground import above as over_ground
from ce_gym.dynamics.forces.ground import above_deepest, reach
from ce_gym.dynamics.recursion.derived import spanning_coordinates
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.dynamics.standing import standing_pose
from ce_gym.model.description import ContactSphere
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism

GROUPS = "foot", "knee", "torso"
"""Groups of contact spheres that terms of the package use; a robot may lack some of them."""


def _buffer(name: str, document: str, default: SX | None = None) -> property:
    """Return a property with the value of a state buffer, or with the default if the task has no such buffer."""

    def read(s: TermContext) -> SX:
        return s._values[name] if default is None else s._values.get(name, SX(default))

    return property(read, doc=document)


class TermContext:
    """One robot at the end of a control step.

    Args:
        mechanism: The robot at a transmission level.
        values: Expressions of the state buffers by name, such as q, v, command, action, clock or load. On a field,
            `seen_ground` has height and slopes of the ground under the base and each contact sphere.
        control_dt: Length of a control step [s].
        gait_period: Period of the gait clock [s].
        contacts: Names of the contact spheres that the physics computes.

    Attributes:
        term: Kind and name of the term that is being traced, which begin the names of its memory.
        memory: Values that terms have recalled, by name of the state.
        resets: Values of the memory at the start of an episode, a number or shape (size,), by name.
        next_memory: Values that terms have kept for the next control step, by name.
        places: Points of a `Lookup` of the ground that a term makes, by name.
        grids: Grid of a `Lookup` by name; empty if the term looks at the places alone.
        heights: Ground heights that a `Lookup` returns [m], shape (n,), by name.
        unit: Draws a number in [0, 1); None while terms are traced without sensor errors, for rewards and critics.
        biases: Sensor errors that are constant over an episode, by name of the state.
        noisy_terms: Terms that use sensor errors.
        exact_pass: Whether noisy terms are traced again for the critic, without errors.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        values: Mapping[str, SX],
        control_dt: float,
        gait_period: float = 1.0,
        contacts: Sequence[str] = (),
    ) -> None:
        self.mechanism, self.control_dt, self._values = mechanism, control_dt, values
        self._gait_period, self._contacts = gait_period, tuple(contacts)
        self.term = ""
        self.memory: dict[str, SX] = {}
        self.resets: dict[str, ArrayLike] = {}
        self.next_memory: dict[str, SX] = {}
        self.places: dict[str, SX] = {}
        self.grids: dict[str, Grid] = {}
        self.heights: dict[str, SX] = {}
        self.unit: Callable[[], SX] | None = None
        self.biases: dict[str, SX] = {}
        self.noisy_terms: set[str] = set()
        self.exact_pass = False
        robot = mechanism.robot
        self._n_joints = len(robot.commanded)
        pose = dict(robot.pose.joints)
        self.standing_joints = np.array([pose.get(name, 0.0) for name in robot.commanded])

    def recall(self, name: str, size: int = 1, reset: ArrayLike = 0.0) -> SX:
        """Return the value that this term kept in the previous control step, shape (size,).

        Memory belongs to one term and one robot.

        Args:
            name: Name of the memory.
            size: Length of the value.
            reset: Value at the start of an episode, a number or shape (size,).
        """
        key = self._key(name)
        if key not in self.memory:
            self.memory[key] = self._values[key] if key in self._values else SX.sym(key, size)
            self.resets[key] = reset
        return self.memory[key]

    def _key(self, name: str) -> str:
        exact = "_exact" if self.exact_pass and self.term in self.noisy_terms else ""
        return f"{self.term}_{name}{exact}".replace("__", "_")  # CasADi's rule for names

    def keep(self, name: str, value: SX) -> None:
        """Keep a value for the next control step, see `recall`.

        Raises:
            ValueError: The term has not called `recall` with this name and size.
        """
        key = self._key(name)
        size = self.memory[key].numel() if key in self.memory else 0
        if SX(value).numel() != size:
            expected = f"recall({name!r}, size={SX(value).numel()}) before"
            raise ValueError(f"{self.term}: keep({name!r}) of {SX(value).numel()} numbers; expected {expected}")
        self.next_memory[key] = ca.densify(ca.vec(SX(value)))

    q = _buffer("q", "Positions, shape (nq,).")
    v = _buffer("v", "Velocities, shape (nv,).")
    command = _buffer("command", "Commanded forward and sideways velocity [m/s] and yaw rate [rad/s], shape (3,).")
    action = _buffer("action", "Action of this control step, clipped, shape (n_joints,).")
    previous_action = _buffer("previous_action", "Action of the previous control step, shape (n_joints,).")
    torque = _buffer("torque", "Motor torque at each joint in the last sub-step [N m], shape (n_joints,).")
    motor_torque = _buffer(
        "motor_torque", "Torque of each motor before friction in the last sub-step [N m], (n_motors,)."
    )
    motor_warmth = _buffer(
        "motor_warmth", "Winding, then housing temperatures above the air [K], (2 n_warm,).", SX(0, 1)
    )
    battery_sag = _buffer("battery_sag", "Voltage drop of the battery under load [V], shape (1,) or (0,).", SX(0, 1))
    load = _buffer("load", "Normal force on each contact in the last sub-step [N], shape (n_contacts,).", SX(0, 1))
    scaled_parameters = _buffer("scaled_parameters", "Randomised parameters, scaled to [-1, 1], shape (n,).", SX(0, 1))
    terrain_level = _buffer("level", "Terrain level of the episode; 0 on flat ground.", SX(0))
    times_grown = _buffer("grown", "Growth steps of the command range, see `ce_gym.envs.task.curriculum`.", SX(0))

    @property
    def contact_forces(self) -> SX:
        """Force on each contact in the last sub-step, in the world [N], shape (3, n_contacts)."""
        return ca.reshape(self._values["contact_forces"], 3, -1)

    @property
    def _njit_value(self) -> SX:
        """Value that an `@njit` function returns, see `ce_gym.numba.reward`."""
        return self._values[self.term.replace("__", "_")]

    def ground_under(self, name: str, places: SX) -> SX:
        """Return heights of the ground under places [m], shape (n,); zeros on flat ground.

        Args:
            name: Name of the look-up.
            places: x and y of each place [m], shape (2, n). They may depend on positions, on `recall` and `drift`, and
                on heights of earlier look-ups.
        """
        return self._look_up(name, ca.vec(places), places.shape[1])

    def ground_around(self, name: str, heading: SX, places: SX, grid: ArrayLike) -> SX:
        """Return heights of the ground on a grid around each place [m], shape (n m,); cheaper than `ground_under`.

        Args:
            name: Name of the look-up.
            heading: Cosine and sine of the angle of the grid, shape (2,).
            places: x and y of each place [m], shape (2, n), as in `ground_under`.
            grid: x and y of the points of the grid relative to a place [m], shape (2, m).
        """
        points = tuple((float(x), float(y)) for x, y in np.asarray(grid).T)
        return self._look_up(name, ca.vertcat(heading, ca.vec(places)), places.shape[1] * len(points), points)

    @property
    def on_field(self) -> bool:
        """Whether the ground is a field and not the plane z = 0."""
        return self._ground.numel() > 0

    def _look_up(self, name: str, places: SX, size: int, grid: Grid = ()) -> SX:
        if not self.on_field:
            return SX(ca.DM.zeros(size))
        key = self._key(name)
        self.places[key], self.grids[key] = places, grid
        return self.heights.setdefault(key, self._values.get(key, SX.sym(key, size)))

    def drift(self, name: str, size: int = 1) -> SX:
        """Return random numbers in [-1, 1) that stay constant over an episode, shape (size,); 0 in exact terms."""
        self.noisy_terms.add(self.term)
        if self.unit is None:
            return SX(ca.DM.zeros(size))
        key = self._key(name)
        return self.biases.setdefault(key, self._values.get(key, SX.sym(key, size)))

    def chance(self, size: int) -> SX:
        """Return random numbers in [0, 1), new in each control step, shape (size,); 1 in exact terms."""
        self.noisy_terms.add(self.term)
        if self.unit is None:
            return SX(ca.DM.ones(size))
        return ca.vertcat(*[self.unit() for _ in range(size)])

    @property
    def exact(self) -> bool:
        """Whether the term is traced without sensor errors, as rewards and blocks of the critic are."""
        self.noisy_terms.add(self.term)
        return self.unit is None

    @property
    def begins(self) -> SX:
        """1 in the first observation of an episode, else 0."""
        return self._values["clock"] == 0

    @property
    def air_time(self) -> SX:
        """Time that each foot had been in the air at the previous control step [s], shape (n_feet,)."""
        self._foot_spheres  # noqa: B018  (raises for a robot without feet)
        return self._values["air_time"]

    @property
    def foot_loads(self) -> list[SX]:
        """Normal force on each foot in the last sub-step [N]; 0 if the physics computes none of its spheres."""
        loads = {name: self.load[i] for i, name in enumerate(self._contacts)}
        feet = self._foot_spheres.values()
        return [sum([loads[sphere.name] for sphere in spheres if sphere.name in loads], SX(0)) for spheres in feet]

    @property
    def phase(self) -> SX:
        """Phase of the gait clock [rad]; 0 at the start of the episode."""
        return (2 * np.pi * self.control_dt / self._gait_period) * self._values["clock"]

    @property
    def time(self) -> SX:
        """Time since the episode began, up to the previous control step [s]."""
        return self.control_dt * self._values["clock"]

    @property
    def joint_positions(self) -> SX:
        """Independent joint positions [rad], shape (n_joints,)."""
        first = self.mechanism.robot.layout.joints_q
        return self.q[first : first + self._n_joints]

    @property
    def joint_velocities(self) -> SX:
        """Independent joint velocities [rad/s], shape (n_joints,)."""
        first = self.mechanism.robot.layout.joints_v
        return self.v[first : first + self._n_joints]

    @property
    def ball_rotations(self) -> SX:
        """Rotation vector of each ball joint from its standing pose, in axes of the moving body [rad], (3 n_balls,)."""
        robot, vectors = self.mechanism.robot, [SX(0, 1)]
        for row, _ in robot.layout.ball_turns:
            w, x, y, z = robot.standing_q[row : row + 4]
            inverse = SX(ca.DM([w, -x, -y, -z]))
            vectors.append(rotation_vector(quaternion_product(inverse, self.q[row : row + 4])))
        return ca.vertcat(*vectors)

    @property
    def ball_velocities(self) -> SX:
        """Angular velocity of each ball joint, in axes of the moving body [rad/s], shape (3 n_balls,)."""
        layout = self.mechanism.robot.layout
        return self.v[layout.base_nv : layout.joints_v] if layout.balls else SX(0, 1)

    @property
    def base_angular_velocity(self) -> SX:
        """Angular velocity of the base in its frame [rad/s], shape (3,)."""
        return self.v[:3]

    @property
    def base_linear_velocity(self) -> SX:
        """Linear velocity of the base in its frame [m/s], shape (3,)."""
        return self.v[3:6]

    @property
    def base_height(self) -> SX:
        """Height of the base origin above the ground [m]."""
        return self.q[2] - self._ground[0] if self.on_field else self.q[2]

    @property
    def _ground(self) -> SX:
        return self._values.get("seen_ground", SX(0, 1))

    @cached_property
    def up(self) -> SX:
        """Upward direction of the world in the base frame, shape (3,); (0, 0, 1) if upright."""
        return self.kinematics.bodies[self.mechanism.robot.bodies[0].name].R[2, :].T

    @cached_property
    def kinematics(self) -> Kinematics:
        """Poses and velocities of all bodies."""
        return outward_velocity_pass(self.mechanism, self.q, self.v, self._values.get("dependent"))

    @property
    def rotor_velocities(self) -> list[SX]:
        """Speed of each rotor [rad/s]."""
        speeds = spanning_coordinates(self.mechanism, self.kinematics)[1]
        return [speeds[rotor.name] for rotor in self.mechanism.robot.rotors()]

    def lowest_points(self, group: str) -> list[tuple[str, SX, SX]]:
        """Return body, height of the lowest point above the ground [m] and velocity [m/s] of each contact of a group.

        The velocity of a contact with a rim is the velocity of the body at the lowest point of the rim.

        Raises:
            ValueError: Neither the robot nor the package has such a group.
        """
        known = {contact.group: None for contact in self.mechanism.robot.contacts} | dict.fromkeys(GROUPS)
        check_names(f"{self.term}: group", [group], known, "a group of contacts among")
        points = []
        for i, sphere in enumerate(self.mechanism.robot.contacts):
            if sphere.group == group:
                body = self.kinematics.bodies[sphere.body]
                centre = constant(np.array(sphere.position))
                above, slopes = body.point_position(centre)[2], []
                if self.on_field:
                    height, *slopes = ca.vertsplit(self._ground[3 * i + 3 : 3 * i + 6])
                    above = over_ground(above, height, *slopes)
                axis = constant(np.array(sphere.axis))
                if sphere.rim:
                    up = body.R[2, :].T
                    centre = centre - above_deepest(0.0, sphere.rim, up, axis, ca.dot(axis, up))
                extent = reach(sphere.radius, sphere.rim, body.R @ axis, *slopes)
                points.append((sphere.body, above - extent, body.R @ body.point_velocity(centre)))
        return points

    @property
    def foot_places(self) -> list[SX]:
        """Mean x and y of the spheres of each foot and z of its lowest point, in the world [m], shape (3,) each."""
        places = []
        for name, spheres in self._foot_spheres.items():
            body, points = self.kinematics.bodies[name], []
            for sphere in spheres:
                extent = reach(sphere.radius, sphere.rim, body.R @ constant(np.array(sphere.axis)))
                points.append(body.point_position(constant(np.array(sphere.position))) - ca.vertcat(0.0, 0.0, extent))
            lowest = ca.mmin(ca.horzcat(*[point[2] for point in points]))
            places.append(ca.vertcat(sum(point[:2] for point in points) / len(points), lowest))
        return places

    @cached_property
    def foot_sides(self) -> list[float]:
        """Mean y of the contact spheres of each foot in the standing pose, positive to the left [m]."""
        standing, sides = standing_pose(self.mechanism), []
        for name, spheres in self._foot_spheres.items():
            y = [standing.p[name][1] + standing.R[name][1] @ np.array(sphere.position) for sphere in spheres]
            sides.append(float(np.mean(y)))
        return sides

    def touching(self, group: str) -> SX:
        """Whether each contact sphere of a group is on the ground, 0 or 1, shape (n,)."""
        return ca.vertcat(SX(0, 1), *[height for _, height, _ in self.lowest_points(group)]) < 0

    @cached_property
    def _foot_spheres(self) -> dict[str, list[ContactSphere]]:
        """Contact spheres of each foot by body; a foot is a body with contacts of the group "foot"."""
        feet: dict[str, list[ContactSphere]] = {}
        for sphere in self.mechanism.robot.contacts:
            if sphere.group == "foot":
                feet.setdefault(sphere.body, []).append(sphere)
        if not feet:
            raise ValueError(f"{self.term}: {self.mechanism.robot.name} has no contact spheres of group 'foot'")
        return feet

    @cached_property
    def _feet(self) -> list[list[tuple[SX, SX]]]:
        """Height and velocity of the contact spheres, foot by foot."""
        points = self.lowest_points("foot")
        return [[(height, v) for body, height, v in points if body == foot] for foot in self._foot_spheres]

    @cached_property
    def foot_heights(self) -> SX:
        """Height of the lowest point of each foot above the ground [m], shape (n_feet,)."""
        lowest = [reduce(ca.fmin, (height for height, _ in spheres)) for spheres in self._feet]
        return ca.vertcat(SX(0, 1), *lowest)

    @cached_property
    def foot_velocities(self) -> SX:
        """Mean velocity of the spheres of each foot, world axes [m/s], shape (3, n_feet)."""
        return ca.horzcat(SX(3, 0), *[sum(v for _, v in spheres) / len(spheres) for spheres in self._feet])

    @cached_property
    def foot_contact(self) -> SX:
        """Whether each foot is on the ground, 0 or 1, shape (n_feet,)."""
        return self.foot_heights < 0

    @cached_property
    def landed(self) -> SX:
        """Whether each foot has touched down in this control step, 0 or 1, shape (n_feet,)."""
        return ca.logic_and(self.foot_contact, self.air_time > 0)

    @cached_property
    def commanded_to_move(self) -> SX:
        """1 if a velocity is commanded, else 0."""
        return ca.sumsqr(self.command) > 0.01
