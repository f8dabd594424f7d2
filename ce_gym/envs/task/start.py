"""How an episode starts: place, pose and velocity of the robot, drawn at random."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.integration import rotate_quaternion
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.model import Model
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.task.terrain_kinds import PLATFORM


def starting_pose(model: Model, task: Task, sampler: Sampler) -> SX:
    """Return positions near the standing pose with a random heading, shape (nq,).

    `Task.start` raises and tilts the base. Elastic transmissions start unstretched.
    """
    layout, standing = model.robot.layout, SX(model.standing_q)
    half_yaw = sampler.uniform(-np.pi / 2, np.pi / 2)
    unstretched = SX(layout.joints - len(model.joint_links), 1)
    n = layout.nv - layout.base_nv - unstretched.numel()
    noise = ca.vertcat(sampler.symmetric(n, task.reset_noise["joint_position"]), unstretched)
    quaternion = ca.vertcat(ca.cos(half_yaw), 0, 0, ca.sin(half_yaw))
    if task.start:
        height, lean = (task.start.get(name, (0.0, 0.0)) for name in ("height", "lean"))
        standing[2] += sampler.uniform(*height)
        direction, angle = sampler.uniform(-np.pi, np.pi), sampler.uniform(*lean)
        quaternion = rotate_quaternion(quaternion, angle * ca.vertcat(ca.cos(direction), ca.sin(direction), 0))
    rows = [row for row, _ in layout.ball_turns]
    balls = [rotate_quaternion(standing[row : row + 4], noise[3 * i : 3 * i + 3]) for i, row in enumerate(rows)]
    joints = standing[layout.joints_q :] + noise[3 * layout.balls :]
    return ca.densify(ca.vertcat(standing[:3], quaternion, *balls, joints))


def starting_velocity(model: Model, task: Task, sampler: Sampler) -> SX:
    """Return velocities near rest, shape (nv,)."""
    base = sampler.symmetric(6, task.reset_noise["base_velocity"])
    stretches = model.robot.layout.joints - len(model.joint_links)
    joints = sampler.symmetric(model.nv - 6 - stretches, task.reset_noise["joint_velocity"])
    return ca.densify(ca.vertcat(base, joints, SX(stretches, 1)))


def starting_place(task: Task, level: SX, sampler: Sampler) -> SX:
    """Return x and y where an episode starts on a field [m]: near the middle of a tile, or in the range of a map."""
    if "begin" in task.terrain:
        return ca.vertcat(*[sampler.uniform(low, high) for low, high in task.terrain["begin"]])
    column = ca.floor(sampler.uniform(0, task.terrain["columns"]))
    middle = task.terrain["size"] * (ca.vertcat(level, column) + 0.5)
    return middle + sampler.symmetric(2, PLATFORM / 2)
