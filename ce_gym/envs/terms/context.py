"""What a reward, observation or termination may ask about one robot at the end of a control step, as SX.

A term is a free function of a `TermContext`. What is here is traced when it is asked for and costs nothing otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

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
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism

GROUPS = "foot", "knee", "torso"
"""Groups of contact spheres that the package's own terms look at; a robot need not have all of them."""


def _buffer(name: str, document: str, default: SX | None = None) -> property:
    """Return a property that is the value of a state buffer, or the default where the task has no such buffer."""

    def read(s: TermContext) -> SX:
        return s._values[name] if default is None else s._values.get(name, SX(default))

    return property(read, doc=document)


class TermContext:
    """One robot at the end of a control step.

    Args:
        mechanism: The robot at a transmission level.
        values: Expressions of the state buffers, by name: q, v, command, action, previous_action, torque,
            air_time, clock, load, scaled_parameters; what terms remember; and seen_ground, height and slopes of the
            ground under the base and each contact sphere, shape (3 (1 + n_spheres),), if it is not flat.
        control_dt: Length of a control step [s].
        gait_period: Time of one cycle of the gait's clock [s].
        contacts: Names of the contact spheres that take part in the physics.

    Attributes:
        term: Kind and name of the term that is being traced, for what it remembers.
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
        """Return what this term kept in the control step before, shape (size,): memory of its own, one of each robot.

        Args:
            name: Of the memory, a word.
            size: How many numbers it has.
            reset: With what an episode begins, a number or shape (size,).
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
        """Keep something for the next control step, see `recall`.

        Raises:
            ValueError: If nothing of that name and size has been recalled.
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
    action = _buffer("action", "The action just carried out, clipped, shape (n_joints,).")
    previous_action = _buffer("previous_action", "The action before it, shape (n_joints,).")
    torque = _buffer("torque", "Motor torque at each joint in the last sub-step [N m], shape (n_joints,).")
    motor_torque = _buffer("motor_torque", "Torque of each motor's windings in the last sub-step [N m], (n_motors,).")
    motor_warmth = _buffer(
        "motor_warmth", "Temperatures of windings, then of housings, above the air [K], shape (2 n_warm,).", SX(0, 1)
    )
    battery_sag = _buffer("battery_sag", "Voltage drop of the battery under load [V], shape (1,) or (0,).", SX(0, 1))
    load = _buffer("load", "Normal force on each contact in the last sub-step [N], shape (n_contacts,).", SX(0, 1))
    scaled_parameters = _buffer(
        "scaled_parameters", "The randomised figures of the episode, each in [-1, 1], shape (n,).", SX(0, 1)
    )
    terrain_level = _buffer("level", "Level of the terrain on which the episode began; 0 on flat ground.", SX(0))
    times_grown = _buffer(
        "grown", "How often the range of commands has grown, see `ce_gym.envs.task.curriculum`.", SX(0)
    )

    def ground_under(self, name: str, places: SX) -> SX:
        """Return heights of the ground under places [m], shape (n,): a look-up, on flat ground just zeros.

        Args:
            name: Of what is found, a word.
            places: x and y of each [m], shape (2, n); of positions, what the term recalls and drifts by, and heights
                that it has found so.
        """
        return self._looked_up(name, ca.vec(places), places.shape[1])

    def ground_around(self, name: str, heading: SX, places: SX, grid: ArrayLike) -> SX:
        """Return heights of the ground around places [m], shape (n m,), place by place, for less than `ground_under`.

        Args:
            name: Of what is found, a word.
            heading: Cosine and sine of the angle by which the grid is turned, shape (2,).
            places: Where it is put, x and y of each [m], shape (2, n); both as for `ground_under`.
            grid: x and y of its points [m], shape (2, m).
        """
        points = tuple((float(x), float(y)) for x, y in np.asarray(grid).T)
        return self._looked_up(name, ca.vertcat(heading, ca.vec(places)), places.shape[1] * len(points), points)

    @property
    def on_field(self) -> bool:
        """Whether the ground is a field, which is looked up, and not the plane z = 0."""
        return self._ground.numel() > 0

    def _looked_up(self, name: str, places: SX, size: int, grid: Grid = ()) -> SX:
        if not self.on_field:
            return SX(ca.DM.zeros(size))
        key = self._key(name)
        self.places[key], self.grids[key] = places, grid
        return self.heights.setdefault(key, self._values.get(key, SX.sym(key, size)))

    def drift(self, name: str, size: int = 1) -> SX:
        """Return errors of a sensor that stay for an episode, in [-1, 1), shape (size,); 0 where terms are exact."""
        self.noisy_terms.add(self.term)
        if self.unit is None:
            return SX(ca.DM.zeros(size))
        key = self._key(name)
        return self.biases.setdefault(key, self._values.get(key, SX.sym(key, size)))

    def chance(self, size: int) -> SX:
        """Return numbers in [0, 1), drawn anew in every control step, shape (size,); 1 where terms are exact."""
        self.noisy_terms.add(self.term)
        if self.unit is None:
            return SX(ca.DM.ones(size))
        return ca.vertcat(*[self.unit() for _ in range(size)])

    @property
    def exact(self) -> bool:
        """Whether terms are exact; a term that looks at this is traced once with errors and once without."""
        self.noisy_terms.add(self.term)
        return self.unit is None

    @property
    def begins(self) -> SX:
        """1 in the first observation of an episode, else 0."""
        return self._values["clock"] == 0

    @property
    def air_time(self) -> SX:
        """How long each foot had been in the air up to the previous control step [s], shape (n_feet,)."""
        self._feet  # noqa: B018  (says so if there are none)
        return self._values["air_time"]

    @property
    def foot_loads(self) -> list[SX]:
        """Normal force on each foot in the last sub-step [N]; 0 on one whose spheres take no part in the physics."""
        self._feet  # noqa: B018  (says so if there are none)
        loads = {contact.body: SX(0) for contact in self.mechanism.robot.contacts if contact.group == "foot"}
        bodies = {contact.name: contact.body for contact in self.mechanism.robot.contacts if contact.group == "foot"}
        for i, name in enumerate(self._contacts):
            if name in bodies:
                loads[bodies[name]] += self.load[i]
        return list(loads.values())

    @property
    def phase(self) -> SX:
        """Where the gait's clock is [rad]; it starts at 0 with the episode."""
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
        """Rotation vector of each ball joint from its standing pose, axes of what it turns [rad], (3 n_balls,)."""
        robot, found = self.mechanism.robot, [SX(0, 1)]
        for row, _ in robot.layout.ball_turns:
            w, x, y, z = robot.standing_q[row : row + 4]
            back = SX(ca.DM([w, -x, -y, -z]))
            found.append(rotation_vector(quaternion_product(back, self.q[row : row + 4])))
        return ca.vertcat(*found)

    @property
    def ball_velocities(self) -> SX:
        """Angular velocity of each ball joint, in the axes of what it turns [rad/s], shape (3 n_balls,)."""
        layout = self.mechanism.robot.layout
        return self.v[layout.base_nv : layout.joints_v] if layout.balls else SX(0, 1)

    @property
    def base_angular_velocity(self) -> SX:
        """In the base frame [rad/s], shape (3,)."""
        return self.v[:3]

    @property
    def base_linear_velocity(self) -> SX:
        """In the base frame [m/s], shape (3,)."""
        return self.v[3:6]

    @property
    def base_height(self) -> SX:
        """Height of the base origin above the ground [m]."""
        return self.q[2] - self._ground[0] if self._ground.numel() else self.q[2]

    @property
    def _ground(self) -> SX:
        return self._values.get("seen_ground", SX(0, 1))

    @cached_property
    def up(self) -> SX:
        """The world's upward direction in the base frame, shape (3,); (0, 0, 1) if upright."""
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
        """Return body, height above the ground [m] and velocity (3,) [m/s] of each contact sphere of a group.

        One that moves around a rim is where it is lowest: the velocity is that of the body there, none if it rolls.

        Raises:
            ValueError: If neither the robot nor the package's own terms know such a group.
        """
        known = {contact.group: None for contact in self.mechanism.robot.contacts} | dict.fromkeys(GROUPS)
        check_names(f"{self.term}: group", [group], known, "a group of contacts among")
        points = []
        for i, sphere in enumerate(self.mechanism.robot.contacts):
            if sphere.group == group:
                body = self.kinematics.bodies[sphere.body]
                centre = constant(np.array(sphere.position))
                above, slopes = body.point_position(centre)[2], []
                if self._ground.numel():
                    height, *slopes = ca.vertsplit(self._ground[3 * i + 3 : 3 * i + 6])
                    above = over_ground(above, height, *slopes)
                axis = constant(np.array(sphere.axis))
                if sphere.rim:
                    up = body.R[2, :].T
                    centre = centre - above_deepest(0.0, sphere.rim, up, axis, ca.dot(axis, up))
                away = reach(sphere.radius, sphere.rim, body.R @ axis, *slopes)
                points.append((sphere.body, above - away, body.R @ body.point_velocity(centre)))
        return points

    @property
    def foot_places(self) -> list[SX]:
        """Mean x and y of the spheres of each foot and z of its lowest point, in the world [m], shape (3,) each."""
        self._feet  # noqa: B018  (says so if there are none)
        spheres: dict[str, list[SX]] = {}
        for sphere in self.mechanism.robot.contacts:
            if sphere.group == "foot":
                body = self.kinematics.bodies[sphere.body]
                away = reach(sphere.radius, sphere.rim, body.R @ constant(np.array(sphere.axis)))
                centre = body.point_position(constant(np.array(sphere.position)))
                spheres.setdefault(sphere.body, []).append(centre - ca.vertcat(0.0, 0.0, away))
        return [
            ca.vertcat(sum(p[:2] for p in points) / len(points), ca.mmin(ca.horzcat(*[p[2] for p in points])))
            for points in spheres.values()
        ]

    @cached_property
    def foot_sides(self) -> list[float]:
        """How far to the left of the base's middle the spheres of each foot are in the standing pose, means [m]."""
        standing, sides = standing_pose(self.mechanism), dict[str, list[float]]()
        for sphere in self.mechanism.robot.contacts:
            if sphere.group == "foot":
                place = standing.p[sphere.body] + standing.R[sphere.body] @ np.array(sphere.position)
                sides.setdefault(sphere.body, []).append(place[1])
        return [float(np.mean(places)) for places in sides.values()]

    def touching(self, group: str) -> SX:
        """Whether each contact sphere of a group is on the ground, 0 or 1, shape (n,)."""
        return ca.vertcat(SX(0, 1), *[height for _, height, _ in self.lowest_points(group)]) < 0

    @cached_property
    def _feet(self) -> dict[str, list[tuple[SX, SX]]]:
        """Height and velocity of the spheres of each foot; a foot is a body with spheres of the group "foot"."""
        feet: dict[str, list[tuple[SX, SX]]] = {}
        for body, height, velocity in self.lowest_points("foot"):
            feet.setdefault(body, []).append((height, velocity))
        if not feet:
            raise ValueError(f"{self.term}: {self.mechanism.robot.name} has no contact spheres of group 'foot'")
        return feet

    @cached_property
    def foot_heights(self) -> SX:
        """Height of the lowest point of each foot above the ground [m], shape (n_feet,)."""
        lowest = []
        for spheres in self._feet.values():
            height = spheres[0][0]
            for other, _ in spheres[1:]:
                height = ca.fmin(height, other)
            lowest.append(height)
        return ca.vertcat(SX(0, 1), *lowest)

    @cached_property
    def foot_velocities(self) -> SX:
        """Mean velocity of the spheres of each foot, world axes [m/s], shape (3, n_feet)."""
        return ca.horzcat(SX(3, 0), *[sum(v for _, v in spheres) / len(spheres) for spheres in self._feet.values()])

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
        """1 if the command asks for motion, else 0."""
        return ca.sumsqr(self.command) > 0.01
