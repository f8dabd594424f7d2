"""Makes the policy that stands, and the toy environment, importable by name."""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "policies"), str(TESTS / "adapters")]
