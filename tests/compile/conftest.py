"""A private kernel cache for the tests, and one way to evaluate an SX function through a compiled kernel."""

import itertools
import os

import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, load_kernel

_numbers = itertools.count()


@pytest.fixture(scope="session", autouse=True)
def kernel_cache(tmp_path_factory):
    """The cache folder of this session, new and empty."""
    before = os.environ.get("CE_GYM_CACHE_DIR")
    folder = tmp_path_factory.mktemp("kernels")
    os.environ["CE_GYM_CACHE_DIR"] = str(folder)
    yield folder
    os.environ.pop("CE_GYM_CACHE_DIR")
    if before is not None:
        os.environ["CE_GYM_CACHE_DIR"] = before


def compile_rows(function, dtype="float64", **options):
    """A kernel that takes the function's inputs as rows i0, i1, ... and gives its outputs as rows o0, o1, ..."""
    inputs = tuple(f"i{i}" for i in range(function.n_in()))
    outputs = tuple(f"o{i}" for i in range(function.n_out()))
    buffers = [Buffer(name, function.numel_in(i), "rows_in") for i, name in enumerate(inputs)]
    buffers += [Buffer(name, function.numel_out(i), "rows_out") for i, name in enumerate(outputs)]
    program = Program(function.name(), tuple(buffers), (Call(function, inputs, outputs),))
    return load_kernel(f"test {next(_numbers)} {function.name()}", lambda: program, dtype)


@pytest.fixture
def evaluate():
    """`evaluate(function, *inputs, dtype=)`: inputs of shape (n, size) to a list of outputs likewise."""

    def run(function, *inputs, dtype="float64"):
        kernel = compile_rows(function, dtype)
        n = len(inputs[0])
        arrays = {f"i{i}": np.ascontiguousarray(x, dtype) for i, x in enumerate(inputs)}
        outputs = {f"o{i}": np.full((n, function.numel_out(i)), np.nan, dtype) for i in range(function.n_out())}
        kernel(arrays | outputs, n)
        return list(outputs.values())

    return run
