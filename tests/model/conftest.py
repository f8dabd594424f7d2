"""Writers of the small robot files that tests bend."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # makes the shared files importable by name

from leg_files import URDF, YAML


@pytest.fixture
def write_robot(tmp_path: Path):
    """Write the two files of the leg and return the path of the YAML file.

    Edits are pairs (old, new) that must be found in one of the two.
    """

    def write(*edits: tuple[str, str], urdf: str = URDF, yaml: str = YAML) -> Path:
        for old, new in edits:
            assert old in urdf or old in yaml, f"{old!r} is in neither file"
            urdf, yaml = urdf.replace(old, new), yaml.replace(old, new)
        (tmp_path / "leg.urdf").write_text(urdf, encoding="utf-8")
        (tmp_path / "leg.yaml").write_text(yaml, encoding="utf-8")
        return tmp_path / "leg.yaml"

    return write


@pytest.fixture
def write(tmp_path: Path):
    """Write MJCF text and return the path of the file."""

    def write(text: str) -> Path:
        (tmp_path / "m.xml").write_text(text)
        return tmp_path / "m.xml"

    return write
