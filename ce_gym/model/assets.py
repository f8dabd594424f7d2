"""The folder of the package's robots."""

from __future__ import annotations

from pathlib import Path

OTHERS: dict[str, Path] = {}
"""Files of robots that other packages have registered, by name."""


def robots() -> list[str]:
    """Return the names of the robots that come with the package.

    Examples:
        >>> "mini_cheetah" in ce_gym.robots()
        True
    """
    return sorted(path.stem for path in assets_folder().glob("*/*.yaml") if path.stem == path.parent.name)


def assets_folder() -> Path:
    """Return the folder of robots: inside an installed package, or beside it in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent / "assets"
