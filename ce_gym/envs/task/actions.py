"""The map from actions to targets of joints or motors, as traced functions."""

from __future__ import annotations

from fnmatch import fnmatchcase

import casadi as ca
import numpy as np

from ce_gym.compile import Call, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.motor_control import standing_motors
from ce_gym.dynamics.forces.scene import Control, target_names
from ce_gym.envs.task.tasks import Task
from ce_gym.model.errors import check_names, listed_names
from ce_gym.model.mechanism import Mechanism

CONTROL: dict[str, Control] = {
    "joint_pd": "position",
    "joint_torque": "torque",
    "motor_pd": "motor_position",
    "motor_torque": "motor_torque",
}
"""Control mode of the dynamics for each meaning of an action."""


class ActionMap:
    """The map from the actions of a task to the targets of the dynamics.

    Args:
        mechanism: The robot at a transmission level.
        task: The task.

    Attributes:
        control: Control mode of the dynamics.
        targets: Name of the joint or rotor of each target.
        moved: Index of the target of each action, shape (n_actions,).
        rest: Targets for zero actions, shape (n_targets,): the standing pose [rad], or 0 [N m].
        scale: Change of the target for an action of 1 [rad or N m], shape (n_actions,).

    Raises:
        ValueError: No joint matches `action_joints`, or actions are torques and a torque limit is missing.
    """

    def __init__(self, mechanism: Mechanism, task: Task) -> None:
        robot = mechanism.robot
        self.control: Control = CONTROL[task.actions]
        self.targets = target_names(mechanism, self.control)
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
        acting = {
            link
            for link, joint in zip(joints, named, strict=True)
            if any(fnmatchcase(link, pattern) or fnmatchcase(joint, pattern) for pattern in task.action_joints)
        }
        if self.control.startswith("motor"):
            moving = [cluster for cluster in clusters if acting & set(cluster.independent)]
            acting = {name for cluster in moving for name in cluster.bodies if name in rotors_of_motors}
        self.moved = [i for i, name in enumerate(self.targets) if name in acting]
        if self.control in ("position", "motor_position"):
            self.rest, self.scale = self._positions(mechanism, task.action_scale)
        else:
            self.rest = np.zeros(len(self.targets))
            motors = {motor.rotor: motor.torque for motor in robot.motors}
            names = [self.targets[i] for i in self.moved]
            self.scale = np.array([motors.get(name, robot.body(name).joint.torque) for name in names])
            if not np.isfinite(self.scale).all():
                needed = f"a torque limit (effort) of every {task.actions.split('_')[0]}"
                raise ValueError(f"{robot.name}: actions={task.actions!r} needs {needed}")

    def _positions(self, mechanism: Mechanism, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Return `rest` and `scale` of position targets.

        An action of 1 on a motor turns the joint that this motor drives most by `scale` [rad], in the standing pose.
        """
        pose = dict(mechanism.robot.pose.joints)
        motors = standing_motors(mechanism) if self.control == "motor_position" else {}
        rest = np.array([motors[name][0] if name in motors else pose.get(name, 0.0) for name in self.targets])
        turns = [motors[self.targets[i]][1] if motors else np.ones(1) for i in self.moved]
        return rest, scale * np.array([ratios[np.argmax(np.abs(ratios))] for ratios in turns])

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
