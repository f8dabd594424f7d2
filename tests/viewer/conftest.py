"""Makes the toy robot and the policy that stands importable by name."""

import sys
from pathlib import Path

for folder in (Path(__file__).parent, Path(__file__).parents[1] / "policies"):
    sys.path.insert(0, str(folder))
