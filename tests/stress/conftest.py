"""Long random tests, `pytest tests/stress -m stress --minutes 10`; short ones run with all others."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add how long each long test goes on, and a folder of robot files."""
    parser.addoption("--minutes", type=float, default=5.0, help="how long each test marked stress goes on")
    parser.addoption("--folder", type=Path, help="robot files (URDF, MJCF) that are compared with MuJoCo and Pinocchio")


@pytest.fixture
def minutes(request: pytest.FixtureRequest) -> float:
    """How long a long test goes on."""
    return request.config.getoption("--minutes")
