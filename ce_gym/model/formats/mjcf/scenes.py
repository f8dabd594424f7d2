"""Hints for MJCF that is spread over several files: a scene without its robot, a robot that needs its scene."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from ce_gym.model.errors import RobotError
from ce_gym.model.formats.text_file import read_text

MOST_SEARCHED = 50
"""How many files beside one are searched for what it lacks."""


def scene_hint(path: Path) -> str:
    """Return which files beside an MJCF file include it, as the end of a message that it cannot stand alone."""
    named = rf"<(?:include|model)\b[^>]*\bfile\s*=\s*[\"'](?:[^\"']*/)?{re.escape(path.name)}[\"']"
    names = [other.name for other, text in _beside(path) if re.search(named, text)]
    return f"; {_listed(names)} includes it: read that file" if names else ""


def robot_hint(path: Path) -> str:
    """Return which files beside a scene have robots, as the end of a message that the scene has none."""
    names = [other.name for other, text in _beside(path) if re.search(r"<(freejoint|joint)\b", text)]
    return f"; this may be a scene for the robot in {_listed(names)}: read that, or <include> it here" if names else ""


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3])


def _beside(path: Path) -> Iterator[tuple[Path, str]]:
    """Iterate over the other MJCF files of a folder and their texts."""
    for other in sorted(path.parent.glob("*.xml"))[:MOST_SEARCHED]:
        if other.name != path.name:
            try:
                text = read_text(other, "an MJCF file")
            except RobotError:
                continue
            if "<mujoco" in text:
                yield other, text
