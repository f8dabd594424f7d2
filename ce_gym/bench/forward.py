# pyright: reportAttributeAccessIssue=false
"""Forward dynamics alone as something to time: our kernel on random states, and MuJoCo's `mj_forward`.

Knows the compiler's public names, models and MuJoCo (whose compiled modules carry no types, hence the line above).
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from ce_gym.bench import mujoco_peer
from ce_gym.bench.timing import Competitor
from ce_gym.compile import Buffer, Call, Kernel, Program, aligned_zeros, lane_count, load_kernel
from ce_gym.dynamics.model import Model
from ce_gym.model.description import Robot


def competitors(robot: Robot, levels: Iterable[str], dtypes: Iterable[str], num_envs: int) -> dict[str, Competitor]:
    """Return what to time, by name; one unit of work is the acceleration of one robot."""
    levels, dtypes = list(levels), list(dtypes)
    ours = {f"ce_gym {level} {dtype}": _ours(robot, level, dtype, num_envs) for level in levels for dtype in dtypes}
    return ours | {f"MuJoCo {level} (mj_forward)": _mujoco(robot, level, 256) for level in levels}


def kernel(robot: Robot, level: str, dtype: str) -> Kernel:
    """Compile forward dynamics of a robot on tiles."""
    model = Model(robot, transmission=level)

    def build() -> Program:
        inputs = (("q", model.nq), ("v", model.nv), ("tau", model.nv), ("vdot", model.nv))
        call = Call(model.casadi_function("forward_dynamics"), ("q", "v", "tau"), ("vdot",))
        return Program(
            f"{robot.name} {level} forward dynamics", tuple(Buffer(name, n, "tiles") for name, n in inputs), (call,)
        )

    return load_kernel(f"bench forward dynamics {level} {robot!r}", build, dtype)


def random_states(model: Model, num_envs: int) -> dict[str, np.ndarray]:
    """Return random positions, velocities and forces, shapes (num_envs, nq or nv)."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (num_envs, model.nq))
    if model.robot.floating:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    shape = (num_envs, model.nv)
    return {"q": q, "v": rng.uniform(-2.0, 2.0, shape), "tau": rng.uniform(-10.0, 10.0, shape), "vdot": np.zeros(shape)}


def _ours(robot: Robot, level: str, dtype: str, num_envs: int) -> Competitor:
    compiled, lanes = kernel(robot, level, dtype), lane_count(dtype)
    num_envs = -(-num_envs // lanes) * lanes
    arrays = {}
    for name, rows in random_states(Model(robot, transmission=level), num_envs).items():
        arrays[name] = aligned_zeros((num_envs // lanes, rows.shape[1], lanes), dtype)
        arrays[name][:] = rows.reshape(-1, lanes, rows.shape[1]).swapaxes(1, 2)
    repeats = 8
    return Competitor(lambda: [compiled(arrays, num_envs) for _ in range(repeats)], num_envs * repeats)


def _mujoco(robot: Robot, level: str, repeats: int) -> Competitor:
    model = mujoco_peer.load(robot, level)
    off = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_SENSOR
    model.opt.disableflags |= off if level != "exact" else mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)

    def forward() -> None:
        for _ in range(repeats):
            mujoco.mj_forward(model, data)

    return Competitor(forward, repeats)
