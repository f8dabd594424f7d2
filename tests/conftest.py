"""Makes what all tests share importable by name, shares tests out to workers, and speeds compilation up."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ce_gym.compile import machine_code
from ce_gym.compile.cache import FOLDER_VARIABLE, cache_folder
from ce_gym.dynamics import batched_function

sys.path.insert(0, str(Path(__file__).parent))

OPTIMISED = (
    *("bench", "compile", "house", "identify", "stress"),
    *("test_adaptive", "test_failures", "test_simulator", "test_substeps", "test_terrain"),
)
"""Folders and files of tests that run optimised kernels, as users do."""

COMPILED = "njit", "test_batched_functions"
"""Folders and files of other tests that compile the quantities of `Model`."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give workers whole files, whose tests share fixtures; pages of the documentation are given one by one."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid if "::test_python_blocks_run[" in nodeid else super()._split_scope(nodeid)

    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None


@pytest.fixture(scope="module", autouse=True)
def quick_kernels(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile without optimisation for all but OPTIMISED: less than half the time, and the same results bit by bit.

    Kernels are cached in a folder of their own, which all workers and later runs share. Quantities are interpreted, to
    the same results but for rounding, because tests evaluate them a few times for each of many small robots.
    """
    folder, names = cache_folder(), {request.path.parent.name, request.path.stem}
    with pytest.MonkeyPatch.context() as patch:
        if not names & {*OPTIMISED, *COMPILED}:
            patch.setattr(batched_function, "LONG", 0)
        if folder and not names & set(OPTIMISED):
            patch.setenv(FOLDER_VARIABLE, str(folder / "quick"))
            patch.setattr(machine_code, "GENERATION", 0)
            patch.setattr(machine_code, "OPTIMISATION", 0)
        yield
