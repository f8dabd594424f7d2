# pyright: reportAttributeAccessIssue=false
"""Forward dynamics and its derivatives as something to time: our kernels on random states, and MuJoCo's `mj_forward`.

(MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import mujoco
import numpy as np

from ce_gym.bench.measure.timing import Competitor
from ce_gym.compile import Buffer, Call, Kernel, Program, aligned_zeros, lane_count, load_kernel, source_fingerprint
from ce_gym.dynamics.model import Model
from ce_gym.export import mujoco_model
from ce_gym.model.description import Robot
from ce_gym.sim.kernel_key import model_key


def kernel(robot: Robot, level: str, dtype: str, derivatives: bool = False) -> Kernel:
    """Compile forward dynamics of a robot, or its derivatives with respect to q, v and tau, on tiles."""
    model = Model(robot, transmission=level)

    def build() -> Program:
        function = model.casadi_function("forward_dynamics")
        if derivatives:
            function = model.derivatives("forward_dynamics", function.name_in()).casadi_function("jacobian")
        given, left = tuple(function.name_in()), tuple(function.name_out())
        sizes = {name: function.numel_in(name) for name in given} | {name: function.numel_out(name) for name in left}
        buffers = tuple(Buffer(name, n, "tiles") for name, n in sizes.items())
        return Program(f"{robot.name} {level} {function.name()}", buffers, (Call(function, given, left),))

    return load_kernel(f"{source_fingerprint(__name__)} {model_key(model)} {derivatives}", build, dtype)


def random_states(model: Model, num_envs: int) -> dict[str, np.ndarray]:
    """Return positions around the standing pose, random velocities and forces, shapes (num_envs, nq or nv)."""
    rng = np.random.default_rng(0)
    q = model.standing_q + rng.uniform(-0.3, 0.3, (num_envs, model.nq))  # loops can still be assembled
    if model.robot.floating:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    shape = (num_envs, model.nv)
    return {"q": q, "v": rng.uniform(-2.0, 2.0, shape), "tau": rng.uniform(-10.0, 10.0, shape), "vdot": np.zeros(shape)}


def ours(
    robot: Robot, level: str, dtype: str, num_envs: int, num_threads: int = 1, derivatives: bool = False
) -> Competitor:
    """Return our kernel on random states as something to time; one unit of work is the acceleration of one robot."""
    compiled, lanes = kernel(robot, level, dtype, derivatives), lane_count(dtype)
    num_envs = -(-num_envs // lanes) * lanes
    rows = random_states(Model(robot, transmission=level), num_envs)
    arrays = {}
    for name, buffer in compiled.buffers.items():
        arrays[name] = aligned_zeros((num_envs // lanes, buffer.size, lanes), dtype)
        if name in rows:
            arrays[name][:] = rows[name].reshape(-1, lanes, buffer.size).swapaxes(1, 2)
    repeats = 8

    def run() -> None:
        for _ in range(repeats):
            compiled(arrays, num_envs, num_threads=num_threads)

    return Competitor(run, num_envs * repeats)


def mujoco_forward(robot: Robot, level: str, repeats: int = 256) -> Competitor:
    """Return `mj_forward` in the standing pose; one unit of work is one call.

    Raises:
        RobotError: If MJCF cannot say what the robot is at this level.
    """
    model = mujoco_model.load(robot, level)
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT if model.neq else mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.disableflags |= off | mujoco.mjtDisableBit.mjDSBL_SENSOR
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)

    def forward() -> None:
        for _ in range(repeats):
            mujoco.mj_forward(model, data)

    return Competitor(forward, repeats)
