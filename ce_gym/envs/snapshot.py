"""What a reward, observation or termination may ask about one robot at the end of a control step, as SX.

A term is a free function of a `Snapshot`. Everything here is traced when it is asked for and costs nothing otherwise.
May know kinematics and mechanisms; no tasks.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import casadi as ca
import numpy as np

from ce_gym.dynamics.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.dynamics.spatial import SX
from ce_gym.model.mechanism import Mechanism


class Snapshot:
    """One robot at the end of a control step.

    Args:
        mechanism: The robot at a transmission level.
        values: Expressions of the state buffers, by name: q, v, command, action, previous_action, torque, air_time.
        control_dt: Length of a control step [s].
    """

    def __init__(self, mechanism: Mechanism, values: Mapping[str, SX], control_dt: float) -> None:
        self.mechanism, self.control_dt, self._values = mechanism, control_dt, values
        robot = mechanism.robot
        self._n_joints = len(robot.independent)
        pose = dict(robot.pose.joints)
        self.standing_joints = np.array([pose.get(name, 0.0) for name in robot.independent])

    @property
    def q(self) -> SX:
        """Positions, shape (nq,)."""
        return self._values["q"]

    @property
    def v(self) -> SX:
        """Velocities, shape (nv,)."""
        return self._values["v"]

    @property
    def command(self) -> SX:
        """Commanded velocity: forward [m/s], sideways [m/s], yaw rate [rad/s], shape (3,)."""
        return self._values["command"]

    @property
    def action(self) -> SX:
        """The action just carried out, clipped, shape (n_joints,)."""
        return self._values["action"]

    @property
    def previous_action(self) -> SX:
        """The action before it, shape (n_joints,)."""
        return self._values["previous_action"]

    @property
    def torque(self) -> SX:
        """Motor torque at each joint in the last sub-step [N m], shape (n_joints,)."""
        return self._values["torque"]

    @property
    def air_time(self) -> SX:
        """How long each foot had been in the air up to the previous control step [s], shape (n_feet,)."""
        return self._values["air_time"]

    @property
    def joint_positions(self) -> SX:
        """Independent joint positions [rad], shape (n_joints,)."""
        return self.q[self.q.shape[0] - self._n_joints :]

    @property
    def joint_velocities(self) -> SX:
        """Independent joint velocities [rad/s], shape (n_joints,)."""
        return self.v[self.v.shape[0] - self._n_joints :]

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
        return self.q[2]

    @cached_property
    def up(self) -> SX:
        """The world's upward direction in the base frame, shape (3,); (0, 0, 1) if upright."""
        return self.kinematics.bodies[self.mechanism.robot.bodies[0].name].R[2, :].T

    @cached_property
    def kinematics(self) -> Kinematics:
        """Poses and velocities of all bodies."""
        return outward_velocity_pass(self.mechanism, self.q, self.v, self._values.get("dependent"))

    def touching(self, group: str) -> SX:
        """Whether each contact sphere of a group is on the ground, 0 or 1, shape (n,)."""
        heights = [SX(0, 1)]
        for sphere in self.mechanism.robot.contacts:
            if sphere.group == group:
                centre = self.kinematics.bodies[sphere.body].point_position(constant(np.array(sphere.position)))
                heights.append(centre[2] - sphere.radius)
        return ca.vertcat(*heights) < 0

    @cached_property
    def foot_contact(self) -> SX:
        """Whether each foot is on the ground, 0 or 1, shape (n_feet,)."""
        return self.touching("foot")

    @cached_property
    def landed(self) -> SX:
        """Whether each foot has touched down in this control step, 0 or 1, shape (n_feet,)."""
        return ca.logic_and(self.foot_contact, self.air_time > 0)

    @cached_property
    def commanded_to_move(self) -> SX:
        """1 if the command asks for motion, else 0."""
        return ca.sumsqr(self.command) > 0.01
