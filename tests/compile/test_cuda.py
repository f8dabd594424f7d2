"""Kernels as CUDA C: run by the processor against the LLVM kernels of the same programs, and compiled for real GPUs."""

import re
from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

from ce_gym.compile import Buffer, Call, Lookup, Program, Repeat, While, load_kernel
from ce_gym.compile.cuda import CudaUnavailable, host_kernel, nvrtc
from ce_gym.compile.cuda.loading import cached_cubin, kernel_name
from ce_gym.compile.cuda.source import BLOCK, LONG, emit_source
from ce_gym.compile.lowering.random import uniform
from ce_gym.compile.program import check_program

DTYPES = pytest.mark.parametrize("dtype", ["float64", "float32"])
N = BLOCK + 5
"""More than one block."""


def tensors(arrays):
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def run_both(program, rows, dtype, n=N, **arguments):
    """Outputs in rows of the LLVM kernel and of the CUDA kernel."""
    results = []
    for cuda in (False, True):
        out = {b.name: np.full((n, b.size), np.nan, b.dtype or dtype) for b in program.buffers if b.kind == "rows_out"}
        if cuda:
            host_kernel(lambda: (program,), dtype)(tensors(rows | out), n, **arguments)
        else:
            load_kernel(f"{program.name} {dtype}", lambda: program, dtype)(rows | out, n, **arguments)
        results.append(out)
    return results


@DTYPES
@pytest.mark.parametrize("slopes", [True, False])
def test_look_up(dtype, slopes, needs_host_compiler):
    points = 4
    buffers = (Buffer("t", 0, "table"), Buffer("f", 3, "rows_in"), Buffer("p", 2 * points, "rows_in"))
    buffers += (Buffer("found", (3 if slopes else 1) * points, "rows_out"),)
    program = Program(f"cuda lookup {slopes}", buffers, (Lookup("t", "f", "p", "found", slopes),))
    rng = np.random.default_rng(0)
    places = rng.uniform(-3, 9, (N, 2 * points))
    places[0, :3] = [np.nan, np.inf, -np.inf]
    rows = {"t": rng.normal(size=(7, 9)), "f": np.tile([0.5, -0.5, 0.75], (N, 1)), "p": places}
    llvm, cuda = run_both(program, {name: row.astype(dtype) for name, row in rows.items()}, dtype)
    np.testing.assert_array_equal(cuda["found"], llvm["found"])
    assert np.isfinite(cuda["found"][1:]).all()


@DTYPES
def test_look_up_of_a_grid(dtype, needs_host_compiler):
    grid = ((-0.5, 0.25), (0.0, 0.0), (0.3, 0.7))
    buffers = (Buffer("t", 0, "table"), Buffer("f", 3, "rows_in"), Buffer("p", 6, "rows_in"))
    lookup = Lookup("t", "f", "p", "found", slopes=False, grid=grid)
    program = Program("cuda grid", (*buffers, Buffer("found", 6, "rows_out")), (lookup,))
    rng = np.random.default_rng(1)
    pose = rng.uniform(-3, 9, (N, 6))
    pose[:, 0], pose[:, 1] = np.cos(pose[:, 0]), np.sin(pose[:, 0])
    pose[BLOCK:, 2:] = rng.uniform(3, 4, (N - BLOCK, 4))  # a tile of the CPU's of which nobody is near the border
    pose[0, :4] = [np.nan, 1.0, np.inf, 2.0]
    rows = {"t": rng.normal(size=(12, 14)), "f": np.tile([0.5, -0.5, 0.75], (N, 1)), "p": pose}
    llvm, cuda = run_both(program, {name: row.astype(dtype) for name, row in rows.items()}, dtype)
    np.testing.assert_array_equal(cuda["found"], llvm["found"])
    assert np.isfinite(cuda["found"][1:]).all()


def stepping():
    """Return a program that counts down where the count is above zero, by calls with a flag."""
    x, more, noise = ca.SX.sym("x"), ca.SX.sym("more"), ca.SX.sym("noise", 2)
    start = ca.Function("start", [x], [x, x > 0])
    down = ca.Function("down", [x, more], [x - more, ca.logic_and(more, x > 1)])
    show = ca.Function("show", [x, noise], [ca.vertcat(x, noise)])
    buffers = (Buffer("given", 1, "rows_in", "float32"), Buffer("x", 1, "scratch"), Buffer("more", 1, "scratch"))
    buffers += (Buffer("noise", 2, "random"), Buffer("out", 3, "rows_out", "float64"))
    call = Call(down, ("x", "more"), ("x", "more"), only_if="more")
    steps = (Call(start, ("given",), ("x", "more")), Repeat("times", (call, call, call)))
    return Program("cuda stepping", buffers, (*steps, Call(show, ("x", "noise"), ("out",))))


@DTYPES
def test_each_thread_leaves_out_what_it_does_not_need(dtype, needs_host_compiler):
    given = (np.arange(N) % 11)[:, None].astype(np.float32)
    for times in (0, 1, 3):
        keys, counters = np.arange(N, dtype=np.uint64) * 77, np.arange(N, dtype=np.int64)
        rows = {"given": given}
        llvm_program = stepping()
        out = np.zeros((N, 3))
        load_kernel(f"stepping {dtype}", stepping, dtype)(
            rows | {"out": out}, N, repeats={"times": times}, keys=keys, counters=counters
        )
        result = torch.zeros((N, 3), dtype=torch.float64)
        held = torch.from_numpy(counters.copy())
        host_kernel(lambda program=llvm_program: (program,), dtype)(
            tensors(rows) | {"out": result},
            N,
            repeats={"times": times},
            keys=torch.from_numpy(keys.view(np.int64)),
            counters=held,
        )
        np.testing.assert_array_equal(result.numpy(), out)
        np.testing.assert_array_equal(out[:, 0], np.maximum(given[:, 0] - 3 * times, 0))
        np.testing.assert_array_equal(held.numpy(), counters + 1)


@DTYPES
def test_each_thread_takes_the_short_way_by_itself(dtype, needs_host_compiler):
    """Threads whose flag is zero execute the short variant of a function, with the same bits."""
    x, z = ca.SX.sym("x"), ca.SX.sym("z")
    flag = z > 0.5
    function = ca.Function("choosing", [x, z], [x * x + x + ca.if_else(flag, ca.sin(x * x), 0), flag])
    buffers = (Buffer("x", 1, "rows_in"), Buffer("z", 1, "rows_in"), Buffer("flag", 1, "scratch"))
    calls = (Call(function, ("x", "z"), ("found", "flag"), short_if_zero=("flag",)),)
    program = Program("cuda short", (*buffers, Buffer("found", 1, "rows_out")), calls)
    rows = {"x": np.random.default_rng(0).normal(size=(N, 1)), "z": (np.arange(N) % 11 == 0)[:, None]}
    llvm, cuda = run_both(program, {name: row.astype(dtype) for name, row in rows.items()}, dtype)
    np.testing.assert_array_equal(cuda["found"], llvm["found"])
    text = emit_source((program,), dtype).text
    assert text.index("choosing_0(x_, z_") < text.index("if (flag_[0] != 0) choosing_1") < text.index("else choosing_2")


def doubling():
    """Return a program that doubles numbers until they are 100 or more and leaves other lanes unchanged."""
    x = ca.SX.sym("x")
    start = ca.Function("start", [x], [x, x < 100])
    double = ca.Function("double", [x], [ca.if_else(x < 100, 2 * x, x), ca.if_else(x < 100, 2 * x, x) < 100])
    show = ca.Function("show", [x], [x])
    buffers = (Buffer("given", 1, "rows_in"), Buffer("x", 1, "scratch"), Buffer("below", 1, "scratch"))
    loop = While("below", (Call(double, ("x",), ("x", "below")),))
    steps = (Call(start, ("given",), ("x", "below")), loop, Call(show, ("x",), ("out",)))
    return Program("cuda doubling", (*buffers, Buffer("out", 1, "rows_out")), steps)


@DTYPES
def test_a_loop_ends_when_no_lane_needs_it(dtype, needs_host_compiler):
    given = np.linspace(1, 120, N, dtype=dtype)[:, None]
    llvm, cuda = run_both(doubling(), {"given": given}, dtype)
    expected = given * 2 ** np.maximum(np.ceil(np.log2(100 / given)), 0).astype(dtype)
    np.testing.assert_array_equal(llvm["out"], expected)
    np.testing.assert_array_equal(cuda["out"], expected)


def test_a_loop_needs_a_flag():
    program = doubling()
    start, double, show = program.calls
    without = replace(program, steps=(start, While("given", (double,)), show))
    with pytest.raises(ValueError, match="flag 'given' of a loop must name a tiles or scratch buffer of size 1"):
        check_program(without)


def test_stages_of_one_launch(needs_host_compiler):
    """The second stage sees results of the first, draws at the next counter, and is skipped where its flag is zero."""
    x, noise = ca.SX.sym("x"), ca.SX.sym("noise")
    add = ca.Function("add", [x, noise], [x + noise, x > 2])
    clear = ca.Function("clear", [noise], [-noise])
    tiles = (Buffer("x", 1, "tiles"), Buffer("due", 1, "tiles"))
    first = Program("first", (*tiles, Buffer("a", 1, "random")), (Call(add, ("x", "a"), ("x", "due")),))
    second = Program("second", (*tiles, Buffer("b", 1, "random")), (Call(clear, ("b",), ("x",)),), skip_unless="due")
    n, before = 9, np.arange(9.0)
    keys, counters = np.arange(n, dtype=np.uint64), np.full(n, 40, np.int64)
    arrays = {"x": torch.from_numpy(before.reshape(1, 1, n).copy()), "due": torch.ones((1, 1, n), dtype=torch.float64)}
    held = torch.from_numpy(counters.copy())
    keys64 = torch.from_numpy(keys.view(np.int64))
    host_kernel(lambda: (first, second), "float64")(arrays, n, keys=keys64, counters=held)
    due = before > 2
    drawn = [uniform(keys, counters + i, 1, "float64")[:, 0] for i in range(2)]
    np.testing.assert_array_equal(arrays["x"].numpy()[0, 0], np.where(due, -drawn[1], before + drawn[0]))
    np.testing.assert_array_equal(held.numpy(), counters + 1 + due)


def test_a_robot_that_is_skipped_stays_as_it_is(needs_host_compiler):
    x = ca.SX.sym("x")
    double = ca.Function("double", [x], [2 * x])
    buffers = (Buffer("x", 1, "tiles"), Buffer("chosen", 1, "tiles"), Buffer("out", 1, "rows_out"))
    program = Program("skip", buffers, (Call(double, ("x",), ("x",)), Call(double, ("x",), ("out",))), "chosen")
    chosen = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)[None, None]
    arrays = {"x": torch.ones((1, 1, 3), dtype=torch.float64), "chosen": chosen}
    arrays["out"] = torch.full((3, 1), 9.0, dtype=torch.float64)
    host_kernel(lambda: (program,), "float64")(arrays, 3)
    np.testing.assert_array_equal(arrays["x"].numpy().ravel(), [2, 1, 2])
    np.testing.assert_array_equal(arrays["out"].numpy().ravel(), [4, 9, 4])


def test_wrong_tensors_are_named(needs_host_compiler):
    kernel = host_kernel(lambda: (stepping(),), "float64")
    with pytest.raises(ValueError, match=r"array 'given' is nothing, expected float32 \(4, 1\) on cpu, contiguous"):
        kernel({}, 4, repeats={"times": 1})
    arrays = {"given": torch.zeros((4, 1)), "out": torch.zeros((4, 3))}
    with pytest.raises(ValueError, match=r"array 'out' is float32 \(4, 3\) on cpu, expected float64 \(4, 3\) on cpu"):
        kernel(arrays, 4, repeats={"times": 1})


def test_stages_that_disagree_are_refused():
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    one = Program("one", (Buffer("x", 1, "tiles"),), (Call(ca.Function("f", [x], [x]), ("x",), ("x",)),))
    two = Program("two", (Buffer("x", 2, "tiles"),), (Call(ca.Function("f", [y], [y]), ("x",), ("x",)),))
    with pytest.raises(ValueError, match="disagree about buffer 'x'"):
        emit_source([one, two], "float64")


def test_calls_of_parts_of_buffers_are_refused():
    x = ca.SX.sym("x")
    call = Call(ca.Function("f", [x], [x]), ("x",), ("x",), times=2)
    with pytest.raises(NotImplementedError, match="program 'parts': calls of parts of buffers have no CUDA form"):
        emit_source([Program("parts", (Buffer("x", 2, "tiles"),), (call,))], "float64")


def test_a_long_function_with_several_callers_stands_once(needs_host_compiler):
    x = ca.SX.sym("x")
    y = x
    for _ in range(LONG):
        y = 1.5 * y * (1 - y)
    f = ca.Function("logistic", [x], [y])
    buffers = (Buffer("a", 1, "rows_in"), Buffer("b", 1, "scratch"), Buffer("c", 1, "rows_out"))
    program = Program("twice", buffers, (Call(f, ("a",), ("b",)), Call(f, ("b",), ("c",))))
    text = emit_source([program], "float64").text
    assert text.count("void logistic_0(") == 1
    assert "__noinline__ void logistic_0(" in text
    llvm, cuda = run_both(program, {"a": np.linspace(0.1, 0.9, N)[:, None]}, "float64")
    np.testing.assert_array_equal(cuda["c"], llvm["c"])


@pytest.fixture
def needs_compiler():
    try:
        nvrtc.compiler_version()
    except CudaUnavailable as problem:
        pytest.skip(f"not compiled for a GPU: {problem}")


@pytest.mark.parametrize("arch", ["sm_80", "sm_90", "sm_100"])
@DTYPES
def test_compiles_for_real_architectures(arch, dtype, needs_compiler):
    code, usage = nvrtc.compile_cubin(emit_source([stepping()], dtype).text, arch)
    assert code[:4] == b"\x7fELF"
    assert 8 <= usage.registers <= 64
    assert usage.spill_loads == 0
    assert usage.occupancy(arch, BLOCK) >= 0.5


@DTYPES
def test_every_operation_compiles(dtype, needs_compiler):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    names = [
        "sin",
        "cos",
        "tan",
        "asin",
        "acos",
        "atan",
        "exp",
        "log",
        "tanh",
        "sqrt",
        "fabs",
        "sign",
        "floor",
        "ceil",
        "logic_not",
    ]
    pairs = [
        "atan2",
        "fmin",
        "fmax",
        "copysign",
        "fmod",
        "remainder",
        "hypot",
        "logic_and",
        "logic_or",
        "lt",
        "le",
        "eq",
        "ne",
    ]
    values = [getattr(ca, name)(x) for name in names] + [getattr(ca, name)(x, y) for name in pairs]
    values += [x**1.7, x**-3, ca.if_else(x > y, ca.inf, y), 1 / x, x / y, -x, 2 * x]
    function = ca.Function("all", [x, y], [ca.vertcat(*values)])
    buffers = (Buffer("x", 1, "tiles"), Buffer("y", 1, "rows_in"), Buffer("out", len(values), "rows_out"))
    buffers += (Buffer("t", 0, "table"), Buffer("f", 3, "tiles"), Buffer("p", 8, "tiles"), Buffer("g", 12, "tiles"))
    program = Program("all", buffers, (Call(function, ("x", "y"), ("out",)), Lookup("t", "f", "p", "g")))
    _, usage = nvrtc.compile_cubin(emit_source([program], dtype).text, "sm_90")
    assert usage.spill_loads == 0


def ptx_of(text):
    """The virtual machine's assembly, which says of every operation how it is rounded, with the options of kernels."""
    from cuda.bindings import nvrtc as raw
    from cuda.core import ProgramOptions

    options = ProgramOptions(arch="sm_90", **nvrtc.OPTIONS).as_bytes("nvrtc")
    error, program = raw.nvrtcCreateProgram(text.encode(), b"", 0, [], [])
    assert not int(error)
    assert not int(raw.nvrtcCompileProgram(program, len(options), options)[0])
    ptx = bytearray(raw.nvrtcGetPTXSize(program)[1])
    raw.nvrtcGetPTX(program, ptx)
    return ptx.decode()


def test_the_compiler_fuses_nothing_by_itself(needs_compiler):
    """Only multiply-adds of the text are fused, and every other operation states its rounding."""
    x, y, z = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("z")
    product = x * y
    function = ca.Function("f", [x, y, z], [ca.vertcat(product + z, product - z, y * z + x)])
    buffers = tuple(Buffer(name, 1, "tiles") for name in "xyz") + (Buffer("out", 3, "tiles"),)
    source = emit_source([Program("ptx", buffers, (Call(function, ("x", "y", "z"), ("out",)),))], "float32")
    assert source.text.count("fmaf(") == 1
    lines = ptx_of(source.text).splitlines()
    used = Counter(line.split()[0] for line in lines if re.match(r"\s+(add|sub|mul|fma)\S*\.f32", line))
    assert used == {"mul.rn.f32": 1, "add.rn.f32": 1, "sub.rn.f32": 1, "fma.rn.f32": 1}


def test_what_the_compiler_refuses_is_one_line(needs_compiler):
    with pytest.raises(RuntimeError, match=r"^// nonsense: sm_90: .*error") as refused:
        nvrtc.compile_cubin("// nonsense\nint f( {", "sm_90")
    assert "\n" not in str(refused.value)


def test_machine_code_is_kept_and_a_damaged_file_made_again(tmp_path, needs_compiler, capsys):
    built = []

    def build():
        built.append(1)
        return (stepping(),)

    first = cached_cubin(tmp_path, "k", build, "float32", "sm_90")
    assert cached_cubin(tmp_path, "k", build, "float32", "sm_90") == first
    assert len(built) == 1
    assert capsys.readouterr().err.count("compiling") == 1
    (tmp_path / "k.kernel").write_bytes(b"damaged")
    assert cached_cubin(tmp_path, "k", build, "float32", "sm_90")[0] == first[0]
    assert len(built) == 2


def test_the_name_depends_on_everything(needs_compiler):
    names = {kernel_name(*facts) for facts in (("a", "float32", "sm_90"), ("b", "float32", "sm_90"))}
    names |= {kernel_name("a", "float64", "sm_90"), kernel_name("a", "float32", "sm_80")}
    assert len(names) == 4


def test_usage_is_read_from_the_log():
    log = """
    16 bytes stack frame, 8 bytes spill stores, 10 bytes spill loads
    Used 96 registers, used 0 barriers, 48 bytes cumulative stack size
    32 bytes stack frame, 1 bytes spill stores, 2 bytes spill loads
    """
    usage = nvrtc.usage_in(log)
    assert usage == nvrtc.Usage(96, 48, 9, 12)
    assert nvrtc.usage_in(log.replace(", 48 bytes cumulative stack size", "")).stack == 0
    assert usage.occupancy("sm_90", 128) == 20 / 64  # 65536 / (96 * 32) = 21 warps, in blocks of 4
    with pytest.raises(RuntimeError, match="does not say"):
        nvrtc.usage_in("")
