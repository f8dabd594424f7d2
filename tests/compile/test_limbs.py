"""One limb per thread: limbs found in a trace, the operations of a thread, and the numbers of the CPU's kernel."""

import casadi as ca
import numpy as np
import pytest
import torch

import ce_gym
from ce_gym.compile import Buffer, Call, Program, Repeat, While, load_kernel
from ce_gym.compile.cuda import CudaUnavailable, host_kernel, limbs, nvrtc
from ce_gym.compile.cuda.limbs import Folded, find_slots, fold, limb_slots
from ce_gym.compile.cuda.source import emit_source
from ce_gym.compile.lowering.graph import graph_of
from ce_gym.sim.devices import Emulated

DTYPES = pytest.mark.parametrize("dtype", ["float64", "float32"])
LENGTHS, SIGNS = (0.3, 0.3, -0.4, -0.4), (1, -1, 1, -1)
N = 21
"""More robots than fit into a warp, and not a multiple."""


def walker(n=4, unlike=False):
    """Return the step of a base with equal limbs of two joints; mirrored limbs differ in constants and signs.

    Args:
        n: Number of limbs.
        unlike: Whether the last limb has another law.
    """
    q, v, dt = ca.SX.sym("q", 1 + 2 * n), ca.SX.sym("v", 1 + 2 * n), ca.SX.sym("dt")
    force, next_v = -2 * q[0], []
    for i in range(n):
        hip, knee = q[1 + 2 * i], q[2 + 2 * i]
        height = q[0] + LENGTHS[i] * ca.cos(hip) + 0.2 * SIGNS[i] * ca.sin(hip + knee)
        push = ca.if_else(height < 0, -height, 0) / (1 + knee**2)
        for _ in range(10):
            push *= 1.1 - 0.1 * push * knee
        force += LENGTHS[i] * push - SIGNS[i] * v[1 + 2 * i] * 0.01
        next_v.append((push, ca.tanh(hip) if unlike and i == n - 1 else ca.sin(hip)))
    acceleration = force / (1 + ca.sumsqr(q[1:]))
    fast = ca.sumsqr(v) > 4
    rows = [v[0] + dt * acceleration]
    for i, (push, spring) in enumerate(next_v):
        rows.append(v[1 + 2 * i] + dt * (SIGNS[i] * push - spring + acceleration * LENGTHS[i]))
        rows.append(v[2 + 2 * i] - dt * (push * acceleration + 0.1 * (v[2 + 2 * i] - v[1 + 2 * i])))
    after = ca.if_else(fast, 0.5 * v, ca.vertcat(*rows))
    return ca.Function("walk", [q, v, dt], [q + dt * after, after, fast])


def program_of(function):
    """Return a program that repeats a step, halves `dt` of fast robots, and shows the state with noise."""
    size = function.numel_in(0)
    dt, fast, q, v, noise = (
        ca.SX.sym("dt"),
        ca.SX.sym("fast"),
        ca.SX.sym("q", size),
        ca.SX.sym("v", size),
        ca.SX.sym("x", 2),
    )
    slow = ca.Function("slow", [dt, fast], [ca.if_else(fast, dt / 2, dt), ca.logic_and(fast, dt > 0.01)])
    show = ca.Function("show", [q, v, noise], [ca.vertcat(q + noise[0], v[::-1] * noise[1])])
    buffers = (Buffer("q", size, "tiles"), Buffer("v", size, "tiles"), Buffer("dt", 1, "tiles"))
    buffers += (
        Buffer("fast", 1, "scratch"),
        Buffer("noise", 2, "random"),
        Buffer("out", 2 * size, "rows_out", "float32"),
    )
    walk = Call(function, ("q", "v", "dt"), ("q", "v", "fast"))
    steps = (walk, While("fast", (Call(slow, ("dt", "fast"), ("dt", "fast")),)))
    return Program("walker", buffers, (Repeat("times", steps), Call(show, ("q", "v", "noise"), ("out",))))


@pytest.fixture
def short(monkeypatch):
    """Let short functions have a thread for each limb."""
    monkeypatch.setattr(limbs, "SHORT", 0)


def test_limbs_are_found():
    slots = find_slots(walker(), ("q", "v", "dt"))
    assert slots["q"] == slots["v"] == [(0,) * 4, (1, 3, 5, 7), (2, 4, 6, 8)]
    assert slots["dt"] == [(0,) * 4]


@pytest.mark.parametrize("function", [walker(1), walker(3), walker(4, unlike=True)])
def test_robots_without_equal_limbs_have_one_thread(function, short):
    assert emit_source((program_of(function),), "float64").threads == 1


def test_a_thread_has_the_operations_of_one_limb(short):
    program = program_of(walker())
    slots, walk = limb_slots((program,)), program.calls[0]
    assert slots["out"][0] == (0,) * 4
    assert (1, 3, 5, 7) in slots["out"]
    graph = graph_of(walk.function)
    assert fold(walk, graph, slots).n_operations < 0.7 * Folded(graph).n_operations


@DTYPES
def test_the_same_numbers(dtype, short, needs_host_compiler):
    program = program_of(walker())
    assert emit_source((program,), dtype).threads == 4
    rng = np.random.default_rng(0)
    state = {"q": rng.normal(size=(9, N)), "v": 0.7 * rng.normal(size=(9, N)), "dt": np.full((1, N), 0.1)}
    keys, counters = np.arange(N, dtype=np.uint64) * 77, np.arange(N, dtype=np.int64)
    lanes = 64 // np.dtype(dtype).itemsize
    tiles = {name: ce_gym.sim.tiles.tiles(N, len(x), dtype) for name, x in state.items()}
    for name, x in state.items():
        ce_gym.sim.tiles.write_rows(tiles[name], x.T)
    assert tiles["q"].shape[-1] == lanes
    out = np.zeros((N, 18), np.float32)
    load_kernel(f"walker {dtype}", lambda: program, dtype)(tiles | {"out": out}, N, {"times": 5}, keys, counters.copy())
    tensors = {name: torch.from_numpy(x[None].astype(dtype)) for name, x in state.items()}
    result, held = torch.zeros((N, 18)), torch.from_numpy(counters.copy())
    kernel = host_kernel(lambda: (program,), dtype)
    kernel(tensors | {"out": result}, N, {"times": 5}, torch.from_numpy(keys.view(np.int64)), held)
    np.testing.assert_array_equal(result.numpy(), out)
    np.testing.assert_array_equal(held.numpy(), counters + 1)
    for name in state:
        np.testing.assert_array_equal(tensors[name][0].numpy().T, ce_gym.sim.tiles.read_rows(tiles[name], N))
    assert len(np.unique(tensors["dt"])) > 1


class Uncompiled(Emulated):
    """Device that keeps the source of the last kernel and compiles nothing."""

    def kernel(self, key, build, dtype):
        self.source = emit_source(build(), dtype)
        self.buffers = {b.name: b for b in self.source.layout.buffers}
        return self


@pytest.mark.parametrize(("dtype", "spills", "size"), [("float32", 200, 80), ("float64", 1700, 120)])
def test_a_quadruped_fits_into_registers(dtype, spills, size):
    try:
        nvrtc.compiler_version()
    except CudaUnavailable as problem:
        pytest.skip(f"not compiled for a GPU: {problem}")
    device = Uncompiled()
    ce_gym.Simulator(ce_gym.Model("mini_cheetah"), device=device, dtype=dtype, contacts="foot", outputs=())
    assert device.source.threads == 4
    code, usage = nvrtc.compile_cubin(device.source.text, "sm_90")
    assert usage.spill_stores <= spills
    assert len(code) <= 1024 * size
