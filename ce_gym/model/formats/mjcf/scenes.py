"""MJCF in several files: the name of the robot in a scene, hints for a scene without its robot and the reverse."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ce_gym.model.errors import RobotError
from ce_gym.model.formats.text_file import read_text

MOST_SEARCHED, MOST_NAMED = 50, 3
"""Number of neighbouring files to search, and to name in a message."""


def scene_hint(path: Path, is_readable: Callable[[Path], bool]) -> str:
    """Return a hint with the neighbouring files that include an MJCF file, as the end of an error message.

    Args:
        path: The file.
        is_readable: Whether MuJoCo reads a file.
    """
    scenes = [other for other, text in _beside(path) if _includes(text, path)]
    names = [other.name for other in scenes[:MOST_NAMED] if is_readable(other)]
    return f"; it is a part of {', '.join(names)}: read that" if names else ""


def robot_hint(path: Path) -> str:
    """Return a hint with the neighbouring files that have robots, as the end of an error message."""
    scene = read_text(path, "an MJCF file")
    names = [
        other.name
        for other, text in _beside(path)
        if re.search(r"<(freejoint|joint)\b", text.partition("<worldbody")[2]) and not _includes(scene, other)
    ]
    listed = ", ".join(names[:MOST_NAMED])
    return f"; this may be a scene for the robot in {listed}: read that, or <include> it here" if names else ""


def robot_name(name: str, path: Path) -> str:
    """Return the name of the robot in a file: for a scene, the name of the model with joints that the file includes.

    Args:
        name: Name of the file's model.
        path: The file.
    """
    if "scene" not in name.lower():
        return name
    for part in re.findall(r"<include\b[^>]*\bfile\s*=\s*[\"']([^\"']+)", read_text(path, "an MJCF file")):
        included = path.parent / part
        if included.is_file() and re.search(r"<(freejoint|joint)\b", text := read_text(included, "an MJCF file")):
            model = re.search(r"<mujoco\b[^>]*\bmodel\s*=\s*[\"']([^\"']+)", text)
            return model[1] if model else included.stem
    return name


def _includes(text: str, part: Path) -> bool:
    """Whether a text of MJCF includes or attaches a file of some name."""
    name = rf"[\"'](?:[^\"']*/)?{re.escape(part.name)}[\"']"
    return re.search(rf"<(?:include|model)\b[^>]*\bfile\s*=\s*{name}", text) is not None


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
