# pyright: reportAttributeAccessIssue=false
"""Competitors of the speed benchmarks: sub-steps and forward dynamics of ce_gym and peers, and the processor's peak.

In sub-steps, targets jitter around the standing pose. Robots return to the standing pose every half second, so that
robots that fall are not timed on the ground.
"""

from __future__ import annotations

import tracemalloc
from itertools import count, islice

import casadi as ca
import mujoco
import numpy as np

from ce_gym.bench.measure.timing import Competitor
from ce_gym.bench.peers import stand
from ce_gym.compile import (
    Buffer,
    Call,
    Kernel,
    Program,
    Repeat,
    aligned_zeros,
    calls_of,
    lane_count,
    load_kernel,
    source_fingerprint,
)
from ce_gym.compile.lowering.counting import floating_point_operations
from ce_gym.dynamics.model import Model
from ce_gym.export import mujoco_model
from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_model import STIFF, Settings
from ce_gym.model import Robot
from ce_gym.sim import Simulator
from ce_gym.sim.kernel_key import model_key
from ce_gym.sim.substeps import substeps

SUBSTEPS = 4
"""Sub-steps in one call, one step of a policy."""
TARGETS = 8
"""Number of sets of targets; calls use them in turn."""
CALLS_UNTIL_RESET = 25
"""Calls after which robots return to the standing pose."""
ROBOT_CALLS = 4096 * CALLS_UNTIL_RESET
"""Robots times calls in one timing; for batches up to 4096 a multiple of half a second."""
CHAINS, LINKS = 16, 4
"""Chains of multiply-adds for the peak: enough to hide the latency of two units, and few enough to stay in registers.
The code computes one chain after the other, so that the links of all chains fit into the CPU's reorder buffer."""
PEAK_REPEATS = 400_000
"""Repeats for several milliseconds, because a core needs time to reach its full speed in vector work."""


def sub_steps(model: Model, dtype: str, num_envs: int, num_threads: int, dt: float) -> Competitor:
    """Return calls of `Simulator.step` with copying of targets; one unit of work is one robot's sub-step."""
    sim = Simulator(model, num_envs, dt, dtype, num_threads)
    start, made = sim.snapshot(), count()
    calls = max(1, ROBOT_CALLS // num_envs)
    targets = np.ascontiguousarray(stand.targets(model.robot, num_envs, TARGETS, seed=2).swapaxes(0, 1))

    def run() -> None:
        for i in islice(made, calls):
            if i % CALLS_UNTIL_RESET == 0:
                sim.restore(start)
            sim.step(targets[i % TARGETS], n_substeps=SUBSTEPS)

    return Competitor(run, num_envs * calls * SUBSTEPS)


def operations(model: Model, dtype: str, dt: float) -> int:
    """Return floating-point operations of one robot's sub-step, without operations that only some steps make."""
    sim = Simulator(model, 1, dt, dtype)
    _, _, steps = substeps(model.mechanism, sim.options, ("torque", "contact_forces"))
    calls = [call for call in calls_of(steps) if isinstance(call, Call) and not call.only_if]
    return sum(floating_point_operations(call.function, dtype) for call in calls)


def bytes_per_robot(model: Model, dtype: str, dt: float) -> int:
    """Return the memory of one additional robot of a Simulator [B]."""
    Simulator(model, 8, dt, dtype)  # loads the kernel, so that its memory is not counted
    sizes = []
    for num_envs in (1024, 2048):
        tracemalloc.start()
        sim = Simulator(model, num_envs, dt, dtype)
        sizes.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        del sim
    return round((sizes[1] - sizes[0]) / 1024)


def mujoco_batch(robot: Robot, level: str, num_envs: int, num_threads: int, dt: float) -> Batch:
    """Return a batch of MuJoCo in the standing pose, with settings with which Mini Cheetah stands.

    Raises:
        RobotError: If MJCF cannot express the robot at this level.
        ValueError: If MuJoCo refuses the robot.
    """
    settings = Settings(dt, "Euler", "Newton", 4, 4, STIFF if level == "exact" else None)
    return Batch(mujoco_model.compile_model(robot, level, settings), num_envs, num_threads)


def mujoco_steps(batch: Batch, robot: Robot) -> Competitor:
    """Return a rollout; one unit of work is one robot's step."""
    calls = CALLS_UNTIL_RESET * max(1, 32 // batch.num_envs)
    driven = [robot.independent.index(name) for name in robot.driven]  # passive joints have no actuator
    targets = stand.targets(robot, batch.num_envs, TARGETS, seed=2)[..., driven]
    controls = [np.repeat(targets[:, i : i + 1], SUBSTEPS, axis=1) for i in range(TARGETS)]
    out, start, made = np.empty((batch.num_envs, SUBSTEPS, batch.states.shape[1])), batch.states.copy(), count()

    def run() -> None:
        for i in islice(made, calls):
            if i % CALLS_UNTIL_RESET == 0:
                batch.states[:] = start
            batch.trajectory(controls[i % TARGETS], out)
            batch.states[:] = out[:, -1]

    return Competitor(run, batch.num_envs * SUBSTEPS * calls)


def silence_mujoco() -> None:
    """Disable MuJoCo's warnings and log about robots that fall."""
    mujoco.set_mju_user_warning(lambda _: None)


def dynamics_kernel(robot: Robot, level: str, dtype: str, derivatives: bool = False) -> Kernel:
    """Return a kernel for forward dynamics of a batch, or for its derivatives with respect to q, v and tau."""
    model = Model(robot, transmission=level)

    def build() -> Program:
        function = model.casadi_function("forward_dynamics")
        if derivatives:
            function = model.derivatives("forward_dynamics", function.name_in()).casadi_function("jacobian")
        inputs, outputs = tuple(function.name_in()), tuple(function.name_out())
        sizes = {name: function.numel_in(name) for name in inputs} | {n: function.numel_out(n) for n in outputs}
        buffers = tuple(Buffer(name, n, "tiles") for name, n in sizes.items())
        return Program(f"{robot.name} {level} {function.name()}", buffers, (Call(function, inputs, outputs),))

    return load_kernel(f"{source_fingerprint(__name__)} {model_key(model)} {derivatives}", build, dtype)


def random_states(model: Model, num_envs: int) -> dict[str, np.ndarray]:
    """Return positions around the standing pose, random velocities and forces, shapes (num_envs, nq or nv)."""
    rng = np.random.default_rng(0)
    q = model.standing_q + rng.uniform(-0.3, 0.3, (num_envs, model.nq))  # small enough for closed loops
    if model.robot.floating:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    shape = (num_envs, model.nv)
    return {"q": q, "v": rng.uniform(-2.0, 2.0, shape), "tau": rng.uniform(-10.0, 10.0, shape), "vdot": np.zeros(shape)}


def forward_dynamics(robot: Robot, level: str, num_envs: int, derivatives: bool = False) -> Competitor:
    """Return forward dynamics of ce_gym, double precision, random states; one unit of work is one robot."""
    kernel, lanes, repeats = dynamics_kernel(robot, level, "float64", derivatives), lane_count("float64"), 8
    num_envs = -(-num_envs // lanes) * lanes
    rows = random_states(Model(robot, transmission=level), num_envs)
    arrays = {}
    for name, buffer in kernel.buffers.items():
        arrays[name] = aligned_zeros((num_envs // lanes, buffer.size, lanes), "float64")
        if name in rows:
            arrays[name][:] = rows[name].reshape(-1, lanes, buffer.size).swapaxes(1, 2)

    def run() -> None:
        for _ in range(repeats):
            kernel(arrays, num_envs, num_threads=1)

    return Competitor(run, num_envs * repeats)


def mujoco_forward(robot: Robot, level: str, repeats: int = 256) -> Competitor:
    """Return `mj_forward` in the standing pose; one unit of work is one call.

    Raises:
        RobotError: If MJCF cannot express the robot at this level.
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


def pinocchio_peer(robot: Robot) -> dict[str, Competitor]:
    """Return Pinocchio's `aba`, its derivatives and a call for a single joint; empty if it is not installed.

    Raises:
        RobotError: If Pinocchio's `aba` does not support the robot.
    """
    try:
        from ce_gym.bench.peers import pinocchio
    except ImportError:
        return {}
    peer = pinocchio.load(robot)
    return {
        "Pinocchio aba": pinocchio.forward_dynamics(peer),
        "Pinocchio computeABADerivatives": pinocchio.derivatives(peer),
        "Pinocchio (call of a single joint)": pinocchio.overhead(),
    }


def peak(dtype: str) -> Competitor:
    """Return chains of multiply-adds in a compiled kernel; one unit of work is one floating-point operation."""
    kernel, lanes = peak_kernel(dtype), lane_count(dtype)
    arrays = {name: aligned_zeros((1, buffer.size, lanes), dtype) for name, buffer in kernel.buffers.items()}
    arrays["factor"][:] = 0.5  # chains converge to 1

    def run() -> None:
        kernel(arrays, lanes, repeats={"times": PEAK_REPEATS}, num_threads=1)

    return Competitor(run, 2 * CHAINS * LINKS * PEAK_REPEATS * lanes)


def peak_kernel(dtype: str) -> Kernel:
    """Return a kernel with `CHAINS` chains that replace x by factor[0] x + factor[1] `LINKS` times."""

    def build() -> Program:
        x, factor = ca.SX.sym("x", CHAINS), ca.SX.sym("factor", 2)
        after = x
        for _ in range(LINKS):
            after = factor[0] * after + factor[1]
        call = Call(ca.Function("chains", [x, factor], [after]), ("x", "factor"), ("x",))
        buffers = (Buffer("x", CHAINS, "tiles"), Buffer("factor", 2, "tiles"))
        return Program("chains of multiply-adds", buffers, (Repeat("times", (call,)),))

    return load_kernel(source_fingerprint(__name__), build, dtype)
