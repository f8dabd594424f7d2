"""The specification of a policy: the data for running the policy on another simulator or on a robot.

The traced terms yield the source of each number of an observation.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.stages import OBSERVATION_BOUND

FORMAT = "ce_gym policy specification, version 2"

MEANINGS = {
    "joint_pd": "joint target [rad] = default_pose + scale * clip(action, -1, 1); torque = kp * (target - position) "
    "- kd * velocity, within torque_limits; joints without an action hold the default pose",
    "joint_velocity": "joint velocity [rad/s] = scale * clip(action, -1, 1); torque = kd * (target - velocity), within "
    "torque_limits; joints without an action are held at rest",
    "joint_torque": "joint torque [N m] = scale * clip(action, -1, 1); joints without an action have none",
    "motor_pd": "rotor target [rad] = rest + scale * clip(action, -1, 1); the gains of a motor are the gains of its "
    "joints, reflected to the rotor in the default pose with the other motors of its cluster at rest",
    "motor_torque": "rotor torque [N m] = scale * clip(action, -1, 1); motors without an action have none",
}
"""Meaning of an action, by its kind."""

COORDINATES = {
    "q": "base position in the world (3) [m], base quaternion w x y z, body to world (4), quaternions of "
    "ball joints, child to parent (4 each), joints in the order of `joints` [rad]",
    "v": "angular (3) [rad/s] and linear velocity (3) [m/s] of the base in the base frame, angular "
    "velocities of ball joints in axes of the moving body (3 each), joints [rad/s]",
    "command": "forward and sideways velocity in the base frame [m/s], yaw rate [rad/s]",
    "action": "the action before this observation, after clipping",
    "gravity": "direction of gravity in the base frame (3); (0, 0, -1) if upright",
    "gait": "sine and cosine of 2 pi t / gait_period, where t is the time since the first observation [s]",
}
"""Sources of the numbers of an observation, by the name in its blocks."""

OF_BLOCKS = {"projected_gravity": "gravity", "gait_phase": "gait"}
"""Blocks that have a source of their own."""


def policy_spec(program: TaskProgram, task: str) -> dict[str, Any]:
    """Return the specification of policies for a task on a robot.

    Args:
        program: The task on the robot.
        task: Name of the task.

    Returns:
        JSON-able data. `joints`, `default_pose` [rad], `kp` [N m/rad], `kd` [N m s/rad] and `torque_limits` [N m] share
        one order; gains that no action uses are 0. An observation is the sequence of `observation["blocks"]`. Entry i
        of a block with a source `of`, one of `coordinates`, is `offset[i] + scale[i] * of[rows[i]]`. The key `meaning`
        describes all other blocks. `latency` [s] is the range in training of the time from measurement to command.
    """
    robot, chosen = program.model.robot, program.task
    joints = robot.commanded
    torques = [robot.body(name).joint.torque for name in joints]
    pose = dict(robot.pose.joints)
    return {
        "format": FORMAT,
        "robot": robot.name,
        "transmission": program.model.transmission,
        "task": task,
        "joints": list(robot.joint_names),
        "default_pose": [float(pose.get(name, 0.0)) for name in joints],
        "kp": _gains(program, "kp"),
        "kd": _gains(program, "kd"),
        "torque_limits": [float(torque) if math.isfinite(torque) else None for torque in torques],
        "standing_height": float(robot.pose.height),
        "control_dt": program.control_dt,
        "physics_dt": chosen.dt,
        "latency": [steps * chosen.dt for steps in chosen.latency],
        "gait_period": chosen.gait_period,
        "action": _action(program),
        "observation": {
            "size": program.observation_size,
            "history": chosen.history,
            "order": "blocks of one observation in this order; then, with a history, older observations, newest first",
            "blocks": _blocks(program),
        },
        "normalisation": {"inside_network": True, "clip": OBSERVATION_BOUND},
        "coordinates": COORDINATES,
        "command": {"range": [list(pair) for pair in chosen.command_range], "period": chosen.command_period},
    }


def _gains(program: TaskProgram, key: str) -> list[float]:
    """Return the gains "kp" or "kd" of all joints, 0 where control does not use them."""
    robot, unused = program.model.robot, {"joint_velocity": ["kp"], "joint_torque": ["kp", "kd"]}
    kinds = dict(zip(program.actions.targets, program.actions.kinds, strict=True))
    values = {name: gain for name, gain in getattr(robot.gains, key) if key not in unused.get(kinds.get(name, ""), ())}
    return [float(values.get(name, 0.0)) for name in robot.commanded]


def _action(program: TaskProgram) -> dict[str, Any]:
    actions = program.actions
    targets, kinds = ([values[i] for i in actions.moved] for values in (actions.targets, actions.kinds))
    different = list(dict.fromkeys(kinds))
    of_motors = different[0].startswith("motor")
    return {
        "kind": different[0] if len(different) == 1 else "mixed",
        "kinds": kinds,
        "meaning": "; ".join(MEANINGS[kind] for kind in different),
        "motors" if of_motors else "joints": targets
        if of_motors
        else list(map(program.model.robot.joint_name, targets)),
        "scale": [float(scale) for scale in actions.scale],
        **({"rest": [float(actions.rest[i]) for i in actions.moved]} if different[0] == "motor_pd" else {}),
        "low": -1.0,
        "high": 1.0,
    }


def _blocks(program: TaskProgram) -> list[dict[str, Any]]:
    function = program.stages.observation_function()
    state = {name: SX.sym(name, function.size1_in(name)) for name in function.name_in()}
    values = dict(zip(function.name_out(), function.call(list(state.values())), strict=True))
    blocks = []
    for name, size in program.observation_sizes.items():
        document = inspect.getdoc(program.observation_terms[name].function) or ""
        noise = {"noise": program.task.noise[name]} if program.task.noise.get(name) else {}
        meaning = " ".join(document.split("\n\n")[0].split())
        source = _source(values[name], state)
        if name in OF_BLOCKS:
            source = {"of": OF_BLOCKS[name], "rows": [*range(size)], "scale": [1.0] * size, "offset": [0.0] * size}
        blocks.append({"name": name, "size": size, "meaning": meaning, **source, **noise})
    return blocks


def _source(block: SX, state: dict[str, SX]) -> dict[str, Any]:
    """Return the source of a block whose entries are scaled and shifted entries of one state buffer, else {}."""
    used = [name for name, symbol in state.items() if ca.depends_on(block, symbol)]
    if len(used) != 1:
        return {}
    symbol = state[used[0]]
    slope = ca.jacobian(block, symbol)
    if ca.symvar(slope):
        return {}
    scales = np.array(ca.evalf(slope))
    if not ((scales != 0).sum(axis=1) == 1).all():
        return {}
    rows = np.argmax(scales != 0, axis=1)
    offset = np.array(ca.evalf(ca.substitute(block, symbol, SX.zeros(*symbol.shape))))[:, 0]
    scale = scales[np.arange(len(rows)), rows]
    return {"of": used[0], "rows": rows.tolist(), "scale": scale.tolist(), "offset": (offset + 0.0).tolist()}
