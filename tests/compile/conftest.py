"""A private kernel cache for the tests, and one way to evaluate an SX function through either lowering."""

import itertools
import os

import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, load_kernel
from ce_gym.compile.cuda import host_kernel
from ce_gym.compile.cuda.host import host_compiler

_numbers = itertools.count()


@pytest.fixture(scope="module", autouse=True)
def kernel_cache(tmp_path_factory):
    """The cache folder of this file's tests, new and empty; tests of other folders share theirs between processes."""
    before = os.environ.get("CE_GYM_CACHE_DIR")
    folder = tmp_path_factory.mktemp("kernels")
    os.environ["CE_GYM_CACHE_DIR"] = str(folder)
    yield folder
    os.environ.pop("CE_GYM_CACHE_DIR")
    if before is not None:
        os.environ["CE_GYM_CACHE_DIR"] = before


def rows_program(function):
    """A program that takes the function's inputs as rows i0, i1, ... and gives its outputs as rows o0, o1, ..."""
    inputs = tuple(f"i{i}" for i in range(function.n_in()))
    outputs = tuple(f"o{i}" for i in range(function.n_out()))
    buffers = [Buffer(name, function.numel_in(i), "rows_in") for i, name in enumerate(inputs)]
    buffers += [Buffer(name, function.numel_out(i), "rows_out") for i, name in enumerate(outputs)]
    return Program(function.name(), tuple(buffers), (Call(function, inputs, outputs),))


def run_llvm(program, arrays, n, dtype):
    kernel = load_kernel(f"test {next(_numbers)} {program.name}", lambda: program, dtype)
    kernel(arrays, n)


def run_cuda(program, arrays, n, dtype):
    """The emitted CUDA C, run by the processor."""
    torch = pytest.importorskip("torch")
    kernel = host_kernel(lambda: (program,), dtype)
    kernel({name: torch.from_numpy(array) for name, array in arrays.items()}, n)


@pytest.fixture
def needs_host_compiler():
    if host_compiler() is None:
        pytest.skip("no C++ compiler here to run emitted CUDA C with")


@pytest.fixture(params=["llvm", "cuda"])
def evaluate(request):
    """`evaluate(function, *inputs, dtype=)`: inputs of shape (n, size) to a list of outputs, shape (n, size) each."""
    if request.param == "cuda":
        request.getfixturevalue("needs_host_compiler")
    run_program = {"llvm": run_llvm, "cuda": run_cuda}[request.param]

    def run(function, *inputs, dtype="float64"):
        n = len(inputs[0])
        arrays = {f"i{i}": np.array(x, dtype, order="C") for i, x in enumerate(inputs)}
        outputs = {f"o{i}": np.full((n, function.numel_out(i)), np.nan, dtype) for i in range(function.n_out())}
        run_program(rows_program(function), arrays | outputs, n, dtype)
        return list(outputs.values())

    return run
