"""The map from actions to targets of joints or motors, as traced functions."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase

import casadi as ca
import numpy as np

from ce_gym.compile import Call, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.motor_control import standing_motors
from ce_gym.dynamics.forces.scene import Control, JointControl, target_names
from ce_gym.envs.task.tasks import Task
from ce_gym.model.description import Robot
from ce_gym.model.errors import check_names, invalid_value, listed_names
from ce_gym.model.mechanism import Mechanism

CONTROL: dict[str, Control] = {
    "joint_pd": "position",
    "joint_velocity": "position",
    "joint_torque": "torque",
    "motor_pd": "motor_position",
    "motor_torque": "motor_torque",
}
"""Control mode of the dynamics if all actions have this meaning."""

JOINT_CONTROL: dict[str, JointControl] = {"joint_velocity": "velocity", "joint_torque": "torque"}
"""Control of a joint in control mode "position", for each meaning of an action but "joint_pd"."""

GAINS = {"joint_pd": ("kp", "kd"), "motor_pd": ("kp", "kd"), "joint_velocity": ("kd",)}
"""Gains that an action needs; position control without any `kd` is undamped."""


class ActionMap:
    """The map from the actions of a task to the targets of the dynamics.

    Args:
        mechanism: The robot at a transmission level.
        task: The task.

    Attributes:
        control: Control mode of the dynamics.
        joint_control: See `StepOptions`.
        kinds: Meaning of each target, shape (n_targets,).
        targets: Name of the joint or rotor of each target.
        moved: Index of the target of each action, shape (n_actions,).
        rest: Targets for zero actions, shape (n_targets,): the standing pose [rad], or 0 [rad/s or N m].
        scale: Change of the target for an action of 1 [rad, rad/s or N m], shape (n_actions,).

    Raises:
        ValueError: No joint matches a pattern, or actions are shares of a limit that is missing.
        RobotError: A gain that the actions need is missing.
    """

    def __init__(self, mechanism: Mechanism, task: Task) -> None:
        robot = mechanism.robot
        kinds = _kinds_of_joints(robot, task.actions)
        self.control = _control(task.actions, kinds)
        self.joint_control: tuple[tuple[str, JointControl], ...] = ()
        if self.control == "position":
            self.joint_control = tuple((name, JOINT_CONTROL[x]) for name, x in kinds.items() if x in JOINT_CONTROL)
        self.targets = target_names(mechanism, self.control)
        self.kinds = [kinds.get(name) or str(task.actions) for name in self.targets]
        self.moved = self._moved(mechanism, task)
        self.rest, self.scale = self._rest(mechanism), self._scale(mechanism, task)
        _check_gains(robot, kinds)

    def _moved(self, mechanism: Mechanism, task: Task) -> list[int]:
        """Return the index of the target of each action."""
        robot = mechanism.robot
        rotors_of_motors = {motor.rotor for motor in robot.motors}
        joints, expected = robot.driven, "patterns of joints among"
        clusters = [cluster for cluster in mechanism.tree.clusters if rotors_of_motors & set(cluster.bodies)]
        if self.control.startswith("motor"):
            motorised = {name for cluster in clusters for name in cluster.independent}
            joints = tuple(name for name in joints if name in motorised)
            expected = f"patterns of joints that motors drive, for actions={task.actions!r}, among"
        named = [robot.joint_name(name) for name in joints]
        check_names("action_joints", task.action_joints, [*named, *joints], expected, patterns=True)
        if not task.action_joints:
            raise ValueError(f"action_joints={task.action_joints!r}; expected {expected} {listed_names('', named)}")
        acting = {name for name in joints if any(_fits(robot, name, pattern) for pattern in task.action_joints)}
        if self.control.startswith("motor"):
            moving = [cluster for cluster in clusters if acting & set(cluster.independent)]
            acting = {name for cluster in moving for name in cluster.bodies if name in rotors_of_motors}
        return [i for i, name in enumerate(self.targets) if name in acting]

    def _rest(self, mechanism: Mechanism) -> np.ndarray:
        pose = dict(mechanism.robot.pose.joints)
        motors = standing_motors(mechanism) if self.control == "motor_position" else {}
        angles = [motors[name][0] if name in motors else pose.get(name, 0.0) for name in self.targets]
        return np.array([x if kind.endswith("_pd") else 0.0 for kind, x in zip(self.kinds, angles, strict=True)])

    def _scale(self, mechanism: Mechanism, task: Task) -> np.ndarray:
        """Return the change of the target for an action of 1.

        A "motor_pd" action turns the joint that its motor drives most by `action_scale` [rad], in the standing pose.
        """
        robot = mechanism.robot
        motors = standing_motors(mechanism) if self.control == "motor_position" else {}
        torques = {motor.rotor: motor.torque for motor in robot.motors}
        scales = []
        for name, kind in ((self.targets[i], self.kinds[i]) for i in self.moved):
            if kind.endswith("_pd"):
                ratios = motors[name][1] if motors else np.ones(1)
                scales.append(task.action_scale * ratios[np.argmax(np.abs(ratios))])
            elif kind == "joint_velocity":
                scales.append(robot.body(name).joint.velocity)
            else:
                scales.append(torques[name] if name in torques else robot.body(name).joint.torque)
            if not np.isfinite(scales[-1]) or (kind == "joint_velocity" and scales[-1] == 0):
                limit = "speed limit (velocity)" if kind == "joint_velocity" else "torque limit (effort)"
                needed = f"a {limit} of every {kind.split('_')[0]}"
                raise ValueError(f"{robot.name}: actions={kind!r} needs {needed}")
        return np.array(scales)

    def act(self, late: bool) -> ca.Function:
        """Trace action_in -> clipped action, target, and 0 sub-steps `waited` for actions with latency."""
        action = SX.sym("action_in", len(self.moved))
        clipped, target = ca.fmax(-1, ca.fmin(1, action)), SX(self.rest)
        target[self.moved] += self.scale * clipped
        waited = {"waited": SX(0)} if late else {}
        return traced("act", {"action_in": action}, {"clipped": clipped, "target": target} | waited)

    def delayed(self, physics: tuple[Step | Repeat, ...]) -> tuple[Step | Repeat, ...]:
        """Return the physics with a choice between the old and the new target before each sub-step."""
        n, waited, delay = len(self.targets), SX.sym("waited"), SX.sym("delay")
        old, new = SX.sym("target", n), SX.sym("new_target", n)
        outputs = {"target_next": ca.if_else(waited < delay, old, new), "waited_next": waited + 1}
        arrive = traced("arrive", {"waited": waited, "delay": delay, "target": old, "new_target": new}, outputs)
        call = Call(arrive, tuple(arrive.name_in()), ("target", "waited"))
        arrived = Call(ca.Function("arrived", [new], [new]), ("new_target",), ("target",))
        steps = [Repeat(step.times, (call, *step.calls)) if isinstance(step, Repeat) else step for step in physics]
        return (*steps, arrived)


def _kinds_of_joints(robot: Robot, actions: str | Mapping[str, str]) -> dict[str, str]:
    """Return the meaning of the action of each joint, by the name of its link.

    Raises:
        ValueError: If a pattern fits no joint, or no pattern fits a joint.
    """
    if isinstance(actions, str):
        return dict.fromkeys(robot.commanded, actions)
    named = [robot.joint_name(name) for name in robot.driven]
    check_names("actions", actions, [*named, *robot.driven], "patterns of joints among", patterns=True)
    kinds = {}
    for name in robot.driven:
        fitting = [kind for pattern, kind in actions.items() if _fits(robot, name, pattern)]
        if not fitting:
            patterns = ", ".join(actions)
            raise ValueError(f"actions: {patterns}; expected a pattern for every joint, here {robot.joint_name(name)}")
        kinds[name] = fitting[-1]
    return {name: kinds.get(name, "joint_pd") for name in robot.commanded}  # passive joints have no torque


def _check_gains(robot: Robot, kinds: Mapping[str, str]) -> None:
    """Check that driven joints have the gains that their actions need.

    Raises:
        RobotError: If a gain is missing, or without effect because it is 0.
    """
    for name in robot.driven:
        for key in GAINS.get(kinds[name], ()):
            gains = dict(getattr(robot.gains, key))
            undamped = key == "kd" and kinds[name].endswith("_pd") and (not gains or name in gains)
            if not (undamped or gains.get(name)):
                place = f"gains.{key}.{robot.joint_name(name)}"
                expected = f"a gain above 0 for actions {kinds[name]!r}"
                raise invalid_value(robot.source or robot.name, place, gains.get(name), expected)


def _control(actions: str | Mapping[str, str], kinds: Mapping[str, str]) -> Control:
    """Return the control mode of the dynamics; torques alone are not control of positions."""
    if isinstance(actions, str):
        return CONTROL[actions]
    return "torque" if {*kinds.values()} == {"joint_torque"} else "position"


def _fits(robot: Robot, name: str, pattern: str) -> bool:
    """Return whether a pattern fits the name of a link or of the joint that moves it."""
    return fnmatchcase(name, pattern) or fnmatchcase(robot.joint_name(name), pattern)
