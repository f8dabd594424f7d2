"""Makes what all tests share importable by name, groups tests for `--dist loadgroup`, and speeds compilation up."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ce_gym.compile import machine_code
from ce_gym.compile.cache import FOLDER_VARIABLE, cache_folder

sys.path.insert(0, str(Path(__file__).parent))

OPTIMISED = (
    *("bench", "compile", "house", "identify", "stress"),
    *("test_adaptive", "test_failures", "test_simulator", "test_substeps", "test_terrain"),
)
"""Folders and files of tests that run optimised kernels, as users do."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests of a file on one worker, which shares their fixtures, unless a test names another group."""
    if config.pluginmanager.hasplugin("xdist"):
        for item in items:
            if not item.get_closest_marker("xdist_group"):
                item.add_marker(pytest.mark.xdist_group(f"{item.path.parent.name}/{item.path.stem}"))


@pytest.fixture(scope="module", autouse=True)
def quick_kernels(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile without optimisation for all but OPTIMISED: less than half the time, and the same results bit by bit.

    Kernels are cached in a folder of their own, which all workers and later runs share.
    """
    folder = cache_folder()
    with pytest.MonkeyPatch.context() as patch:
        if folder and not {request.path.parent.name, request.path.stem} & set(OPTIMISED):
            patch.setenv(FOLDER_VARIABLE, str(folder / "quick"))
            patch.setattr(machine_code, "GENERATION", 0)
            patch.setattr(machine_code, "OPTIMISATION", 0)
        yield
