"""How a kernel treats buffers, tiles, threads and wrong arguments."""

import ctypes
import os
import time
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Foreign, Program, Repeat, aligned_zeros, lane_count, load_kernel

DTYPES = ["float64", "float32"]


def pipeline():
    """A small environment: rows in, noise, repeated steps in place, rows out."""
    state, action, noise, work = (ca.SX.sym(name, size) for name, size in zip("sanw", (3, 2, 2, 2), strict=True))
    mix = ca.Function("mix", [action, noise], [ca.sin(action) + 0.1 * noise])
    step = ca.Function(
        "step", [state, work], [ca.vertcat(state[1], ca.cos(state[0]) + work[0], state[2] / (1 + work[1] ** 2) + 1)]
    )
    observe = ca.Function("observe", [state, work], [ca.vertcat(state, ca.sumsqr(state)), work[0] * state[2]])
    buffers = (
        Buffer("state", 3, "tiles"),
        Buffer("awake", 1, "tiles"),
        Buffer("action", 2, "rows_in", "float32"),
        Buffer("noise", 2, "random"),
        Buffer("work", 2, "scratch"),
        Buffer("observation", 4, "rows_out", "float32"),
        Buffer("reward", 1, "rows_out"),
    )
    calls = (
        Call(mix, ("action", "noise"), ("work",)),
        Repeat("n_substeps", (Call(step, ("state", "work"), ("state",)),)),
        Call(observe, ("state", "work"), ("observation", "reward")),
    )
    return Program("pipeline", buffers, calls, skip_unless="awake")


@pytest.fixture(scope="module", params=DTYPES)
def kernel(request):
    return load_kernel("pipeline", pipeline, request.param)


def arrays_for(kernel, num_envs, seed=0):
    """Arrays of a batch whose environment i is the same in every batch."""
    n_tiles = -(-num_envs // kernel.lanes)
    rng = np.random.default_rng(seed)
    everybody = rng.uniform(-1, 1, (2000, 5))
    state = aligned_zeros((n_tiles, 3, kernel.lanes), kernel.dtype)
    padded = np.resize(everybody[:num_envs, :3], (n_tiles * kernel.lanes, 3))
    state[:] = padded.reshape(n_tiles, kernel.lanes, 3).transpose(0, 2, 1)
    awake = aligned_zeros((n_tiles, 1, kernel.lanes), kernel.dtype)
    awake[:] = 1
    return {
        "state": state,
        "awake": awake,
        "action": everybody[:num_envs, 3:].astype(np.float32),
        "observation": np.full((num_envs, 4), -7, np.float32),
        "reward": np.full((num_envs, 1), -7, kernel.dtype),
    }


def run(kernel, num_envs, num_threads=1, n_substeps=3, arrays=None):
    arrays = arrays or arrays_for(kernel, num_envs)
    keys, counters = np.arange(num_envs, dtype=np.uint64) * 977, np.arange(num_envs, dtype=np.int64) - 3
    kernel(arrays, num_envs, {"n_substeps": n_substeps}, keys, counters, num_threads)
    return arrays


def test_values(kernel):
    from ce_gym.compile.lowering.random import uniform

    num_envs, before = 21, arrays_for(kernel, 21)
    after = run(kernel, num_envs)
    keys, counters = np.arange(num_envs, dtype=np.uint64) * 977, np.arange(num_envs, dtype=np.int64) - 3
    noise = uniform(keys, counters, 2, kernel.dtype)
    for env in range(num_envs):
        tile, lane = divmod(env, kernel.lanes)
        s = before["state"][tile, :, lane].astype(float)
        w = np.sin(before["action"][env].astype(float)) + 0.1 * noise[env]
        for _ in range(3):
            s = np.array([s[1], np.cos(s[0]) + w[0], s[2] / (1 + w[1] ** 2) + 1])
        np.testing.assert_allclose(after["state"][tile, :, lane], s, rtol=1e-6)
        np.testing.assert_allclose(after["observation"][env], [*s, s @ s], rtol=2e-6)
        np.testing.assert_allclose(after["reward"][env], w[0] * s[2], rtol=1e-5)


@pytest.mark.parametrize("num_envs", [1, 7, 16, 23, 1024, 1999])
@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_result_depends_on_neither_batch_nor_threads(kernel, num_envs, num_threads):
    whole = run(kernel, 2000)
    part = run(kernel, num_envs, num_threads)
    for name in ("observation", "reward"):
        np.testing.assert_array_equal(part[name], whole[name][:num_envs], strict=True)


def test_result_does_not_depend_on_the_lane(kernel):
    shifted = arrays_for(kernel, 64)
    for array in shifted.values():
        array[:] = np.roll(array, 1, 0) if array.ndim == 2 else array
    rolled = np.roll(arrays_for(kernel, 64)["state"].transpose(0, 2, 1).reshape(64, 3), 1, 0)
    shifted["state"][:] = rolled.reshape(-1, kernel.lanes, 3).transpose(0, 2, 1)
    keys, counters = np.roll(np.arange(64, dtype=np.uint64) * 977, 1), np.roll(np.arange(64, dtype=np.int64) - 3, 1)
    kernel(shifted, 64, {"n_substeps": 3}, keys, counters)
    np.testing.assert_array_equal(shifted["observation"], np.roll(run(kernel, 64)["observation"], 1, 0))


def test_rows_past_the_last_environment_are_not_touched(kernel):
    arrays = arrays_for(kernel, 2 * kernel.lanes)
    n = kernel.lanes + 3
    views = {name: array[:n] if array.ndim == 2 else array for name, array in arrays.items()}
    run(kernel, n, arrays=views)
    assert (arrays["observation"][n:] == -7).all()
    assert (arrays["reward"][n:] == -7).all()
    assert (arrays["reward"][:n] != -7).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_padding_lanes_repeat_the_last_row(dtype):
    x = ca.SX.sym("x", 2)
    buffers = (Buffer("rows", 2, "rows_in"), Buffer("lanes", 2, "tiles"))
    program = Program("copy", buffers, (Call(ca.Function("copy", [x], [x]), ("rows",), ("lanes",)),))
    lanes = lane_count(dtype)
    tiles, rows = aligned_zeros((2, 2, lanes), dtype), np.arange(4 * lanes, dtype=dtype).reshape(-1, 2) + 1
    load_kernel("copy", lambda: program, dtype)({"rows": rows[: lanes + 3], "lanes": tiles}, lanes + 3)
    expected = np.concatenate([rows[: lanes + 3], np.repeat(rows[lanes + 2 : lanes + 3], lanes - 3, 0)])
    np.testing.assert_array_equal(tiles.transpose(0, 2, 1).reshape(-1, 2), expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_functions_of_the_caller(dtype):
    """They see the lanes of a tile in each repetition, and change them."""
    x, number = ca.SX.sym("x", 2), ctypes.c_int64
    double = Call(ca.Function("double", [x], [2 * x]), ("lanes",), ("lanes",))
    steps = (Repeat("n", (Foreign("add", ("lanes", "rows")), double)),)
    program = Program("foreign", (Buffer("rows", 2, "rows_in"), Buffer("lanes", 2, "tiles")), steps)
    lanes, seen = lane_count(dtype), []
    scalar = ctypes.POINTER(ctypes.c_double if dtype == "float64" else ctypes.c_float)

    @ctypes.CFUNCTYPE(None, number, number, scalar, number, scalar, number)
    def add(first, count, to, to_size, rows, rows_size):
        seen.append((first, count, to_size, rows_size))
        to, rows = (np.ctypeslib.as_array(array, (2, lanes)) for array in (to, rows))
        to[:, :count] += rows[:, :count]

    tiles, rows = aligned_zeros((2, 2, lanes), dtype), np.arange(4 * lanes, dtype=dtype).reshape(-1, 2)
    kernel = load_kernel("functions of the caller", lambda: program, dtype)
    address = ctypes.cast(add, ctypes.c_void_p).value
    kernel({"rows": rows[: lanes + 3], "lanes": tiles}, lanes + 3, {"n": 2, "add": address})
    assert seen == 2 * [(0, lanes, 2, 2)] + 2 * [(lanes, 3, 2, 2)]
    np.testing.assert_array_equal(tiles.transpose(0, 2, 1).reshape(-1, 2)[: lanes + 3], 6 * rows[: lanes + 3])
    assert not tiles[1, :, 3:].any()


def test_sleeping_tiles_are_left_alone(kernel):
    num_envs = 3 * kernel.lanes
    arrays, before = arrays_for(kernel, num_envs), arrays_for(kernel, num_envs)
    arrays["awake"][:] = 0
    arrays["awake"][1, 0, 2] = 0.5  # one lane is enough
    run(kernel, num_envs, arrays=arrays)
    rows = slice(kernel.lanes, 2 * kernel.lanes)
    awake = run(kernel, num_envs)
    for name in ("observation", "reward"):
        np.testing.assert_array_equal(arrays[name][rows], awake[name][rows])
        assert (np.delete(arrays[name], rows, 0) == -7).all()
    np.testing.assert_array_equal(arrays["state"][[0, 2]], before["state"][[0, 2]])
    np.testing.assert_array_equal(arrays["state"][1], awake["state"][1])


def test_no_environments_and_no_repeats(kernel):
    run(kernel, 0)
    before, after = arrays_for(kernel, 9), run(kernel, 9, n_substeps=0)
    np.testing.assert_array_equal(after["state"], before["state"])


def test_many_threads_at_once(kernel):
    """Two Python threads may use one kernel at a time."""
    from concurrent.futures import ThreadPoolExecutor

    expected = run(kernel, 999)["observation"]
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: run(kernel, 999, 2)["observation"], range(40)):
            np.testing.assert_array_equal(result, expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(kernel):
    expected = run(kernel, 500, 2)["observation"]
    child = os.fork()
    if child == 0:
        equal = np.array_equal(run(kernel, 500, 2)["observation"], expected)
        os._exit(0 if equal else 1)
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            assert os.waitstatus_to_exitcode(status) == 0
            return
        time.sleep(0.02)
    os.kill(child, 9)
    os.waitpid(child, 0)
    pytest.fail("the child hangs")


WRONG = {
    "missing": (lambda a: a.pop("action"), r"array 'action' is nothing, expected float32 \(20, 2\)"),
    "list": (lambda a: a.update(action=[1.0]), "array 'action' is list, expected float32"),
    "shape": (lambda a: a.update(action=a["action"][:5]), r"'action' is float32 \(5, 2\) C order, expected"),
    "dtype": (lambda a: a.update(action=a["action"].astype(np.int32)), r"'action' is int32 \(20, 2\)"),
    "order": (lambda a: a.update(action=np.asfortranarray(a["action"])), "'action' is float32 .* not in C order"),
    "read-only": (lambda a: a["reward"].setflags(write=False), "array 'reward' is read-only, expected a writeable one"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arrays_are_refused(kernel, case):
    spoil, message = WRONG[case]
    arrays = arrays_for(kernel, 20)
    spoil(arrays)
    with pytest.raises(ValueError, match=f"^kernel 'pipeline': .*{message}"):
        run(kernel, 20, arrays=arrays)


def test_wrong_calls_are_refused(kernel):
    arrays = arrays_for(kernel, 20)
    keys, counters = np.zeros(20, np.uint64), np.zeros(20, np.int64)
    with pytest.raises(ValueError, match="repeats lacks 'n_substeps'"):
        kernel(arrays, 20, {}, keys, counters)
    with pytest.raises(ValueError, match="array 'keys' is nothing, expected uint64"):
        kernel(arrays, 20, {"n_substeps": 1})
    with pytest.raises(ValueError, match="array 'counters' is uint64"):
        kernel(arrays, 20, {"n_substeps": 1}, keys, keys)
    unaligned = np.zeros(arrays["state"].size + 8, kernel.dtype)
    start = next(i for i in range(1, 9) if unaligned[i:].ctypes.data % 64)
    arrays["state"] = unaligned[start : start + arrays["state"].size].reshape(arrays["state"].shape)
    with pytest.raises(ValueError, match="array 'state' is not aligned"):
        run(kernel, 20, arrays=arrays)


@pytest.mark.parametrize("dtype", DTYPES)
def test_aligned_zeros(dtype):
    for shape in (3, (5, 7), (2, 3, 4)):
        array = aligned_zeros(shape, dtype)
        assert array.ctypes.data % 64 == 0
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert array.dtype == dtype
        assert not array.any()
    assert aligned_zeros(3, dtype).shape == (3,)
    assert aligned_zeros((0, 4), dtype).shape == (0, 4)
    assert lane_count(dtype) * np.dtype(dtype).itemsize == 64


def test_other_dtypes_are_refused():
    with pytest.raises(ValueError, match="dtype: 'int32', expected 'float64' or 'float32'"):
        lane_count(np.int32)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rows", DTYPES)
def test_many_values_become_rows(dtype, rows):
    """Whole tiles are transposed block by block, the last block overlapping; the last tile is only partly rows."""
    size, num_envs = 1003, 37
    x = ca.SX.sym("x", size)
    buffers = (Buffer("x", size, "tiles"), Buffer("y", size, "rows_out", rows))
    call = Call(ca.Function("twice", [x], [2 * x]), ("x",), ("y",))
    kernel = load_kernel(f"many values {rows}", lambda: Program("many", buffers, (call,)), dtype)
    values = aligned_zeros((-(-num_envs // kernel.lanes), size, kernel.lanes), dtype)
    values[:] = np.random.default_rng(0).normal(size=values.shape)
    found = np.zeros((num_envs + 1, size), rows)
    kernel({"x": values, "y": found[:num_envs]}, num_envs)
    expected = 2 * values.transpose(0, 2, 1).reshape(-1, size)[:num_envs]
    np.testing.assert_array_equal(found[:num_envs], expected.astype(rows))
    assert not found[num_envs].any()


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_a_compact_program_gives_the_same_bits(kernel, parts, monkeypatch):
    monkeypatch.setattr("ce_gym.compile.machine_code.registers_per_vector", lambda: parts)
    compact = load_kernel(f"compact {parts}", lambda: replace(pipeline(), compact=True), kernel.dtype)
    expected = run(kernel, 21)
    for name, values in run(compact, 21).items():
        np.testing.assert_array_equal(values, expected[name])


@pytest.mark.parametrize("compact", [False, True])
def test_a_call_is_applied_to_part_after_part(compact):
    """Of buffers that are so many times as large, and of one that is a part of another; the others are shared."""
    x, shift = ca.SX.sym("x", 2), ca.SX.sym("shift")
    apart = ca.Function("apart", [x, shift], [ca.vertcat(x[1] + shift, 2 * x[0], x[0] * x[1])])
    swapped = ca.Function("swapped", [x], [ca.vertcat(x[1], x[0])])
    ones = ca.Function("ones", [], [ca.SX.ones(10)])
    buffers = (
        Buffer("given", 6, "rows_in"),
        Buffer("shift", 1, "rows_in"),
        Buffer("result", 10, "rows_out"),
        Buffer("tail", 9, "scratch", within="result", start=1),
    )
    steps = (
        Call(ones, (), ("result",)),
        Call(apart, ("given", "shift"), ("tail",), times=3),
        Call(swapped, ("given",), ("given",), times=3),
    )
    program = Program("parts", buffers, steps[:2], compact=compact)
    kernel, rng = load_kernel(f"parts {compact}", lambda: program), np.random.default_rng(0)
    given, shift, result = rng.normal(size=(11, 6)), rng.normal(size=(11, 1)), np.zeros((11, 10))
    kernel({"given": given, "shift": shift, "result": result}, 11)
    pairs = given.reshape(11, 3, 2)
    expected = np.stack([pairs[..., 1] + shift, 2 * pairs[..., 0], pairs[..., 0] * pairs[..., 1]], axis=2)
    np.testing.assert_array_equal(result, np.hstack([np.ones((11, 1)), expected.reshape(11, 9)]))
    in_place = replace(program, steps=(steps[0], steps[2], steps[1]))
    kernel = load_kernel(f"parts in place {compact}", lambda: in_place)
    kernel({"given": given, "shift": shift, "result": result}, 11)
    np.testing.assert_array_equal(result[:, 1::3], pairs[..., 0] + shift)
