"""Object code for CPUs that can do less than this one: library functions do the rest, and the bits are the same."""

import platform
from functools import partial

import casadi as ca
import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.compile import Buffer, Call, Program, load_kernel, machine_code

X, Y = ca.SX.sym("x"), ca.SX.sym("y")
EXPRESSIONS = [X * Y + 0.1, ca.floor(X), ca.ceil(Y), ca.sqrt(X * X + 1), ca.sin(X), ca.exp(Y), ca.fmin(X, Y)]


def build(compact):
    f = ca.Function("f", [X, Y], [ca.vertcat(*EXPRESSIONS)])
    buffers = (Buffer("x", 1, "rows_in"), Buffer("y", 1, "rows_in"), Buffer("z", len(EXPRESSIONS), "rows_out"))
    return Program("elementary", buffers, (Call(f, ("x", "y"), ("z",)),), compact=compact)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="compiles for other x86-64")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_every_cpu_gives_the_same_bits(dtype, monkeypatch):
    """Among them the first x86-64, which neither fuses nor rounds to integers: libm's functions do it for it.

    Compact programs, which fewer passes go over, give the same bits as others.
    """
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 50, 1)).astype(dtype) * 3
    outputs, codes, all_passes = [], [], []
    compiled = machine_code.compile_object

    def observed(emit, thorough):
        all_passes.append(thorough)
        codes.append(compiled(emit, thorough))
        return codes[-1]

    monkeypatch.setattr(machine_code, "compile_object", observed)
    for cpu in (None, "haswell", "x86-64"):
        if cpu:
            monkeypatch.setattr(machine_code, "host_cpu", lambda cpu=cpu: (cpu, ""))
        for compact in (False, True):
            kernel = load_kernel(f"elementary on {cpu}, {compact}", partial(build, compact), dtype)
            outputs.append(np.zeros((50, len(EXPRESSIONS)), dtype))
            kernel({"x": x, "y": y, "z": outputs[-1]}, 50)
    np.testing.assert_array_equal(outputs[0][:, 1], np.floor(x[:, 0]))
    for output in outputs[1:]:
        np.testing.assert_array_equal(output, outputs[0])
    assert [b"\0fma" in code for code in codes[2:]] == [False, False, True, True]
    assert all_passes == 3 * [True, False]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels_without_optimisation_give_the_same_bits(dtype, monkeypatch, tmp_path):
    """Steps, randomisation and resets of an environment, compiled with the settings of tests/conftest.py."""
    episodes = []
    for optimised in (True, False):
        if not optimised:
            monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path))
            monkeypatch.setattr(machine_code, "GENERATION", 0)
            monkeypatch.setattr(machine_code, "OPTIMISATION", 0)
        options = {"robot": TRIPOD, "dtype": dtype, "max_episode_steps": 20, "randomise": {"friction": [0.5, 1.2]}}
        envs = gymnasium.make_vec("ce_gym/MiniCheetahVelocity-v0", num_envs=21, terrain="rough", **options)
        rng, seen = np.random.default_rng(0), [envs.reset(seed=0)[0]]
        for _ in range(50):
            seen += envs.step(rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32))[:2]
        episodes.append(np.concatenate([np.ravel(part) for part in seen]))
        envs.close()
    np.testing.assert_array_equal(*episodes)
