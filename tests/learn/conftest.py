"""Makes training scripts and the toy environment importable by name."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
for folder in (ROOT / "train", ROOT / "tests" / "adapters", ROOT / "tests" / "learn", ROOT):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
