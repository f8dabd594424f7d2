"""Limits on the size of an MJCF file, checked before MuJoCo's compiler reads the file.

Elements are counted with the copies of `replicate`, `composite` and `flexcomp` and with included files. Every file of
an asset must be a regular file.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ce_gym.model.errors import RobotError, invalid_value
from ce_gym.model.formats.text_file import check_regular, one_line, read_bytes

MOST_ELEMENTS = 10_000
"""Most elements of a file, copies counted."""
MOST_FILES = 50
"""Most files that include each other."""
LARGEST_SIZE = 10_000
"""Largest number of copies, rows or pixels of an element."""
LARGEST_PICTURE = 2**24
"""Most pixels of a texture, or points of a height field."""
LARGEST_ASSET = 2**27
"""Largest mesh, texture or height field file [bytes]."""
LARGEST_MEMORY = 2**30
"""Largest arena [bytes]."""

_SIZES = ("count", "nrow", "ncol", "width", "height", "gridsize")
_LARGEST = {"njmax": 10**7, "nconmax": 10**7, "nstack": 10**8}  # of <size>, beside LARGEST_SIZE
_PAIRS = (("nrow", "ncol"), ("width", "height"))
_COPIES = ("replicate", "composite", "flexcomp")
_UNITS = {unit: 1024**power for power, unit in enumerate("KMGTPE", start=1)}


def check_file(path: Path) -> None:
    """Check an MJCF file and the files that it includes.

    Raises:
        RobotError: The file is not MJCF, is too large, or has NaN or a range with its ends swapped.
    """
    pages: dict[Path, Element] = {}
    _read_pages(path, path.parent, pages)
    folders = {page.parent for page in pages}
    subfolders = {root.get(key) for root in _all(pages, "compiler") for key in ("assetdir", "meshdir", "texturedir")}
    folders |= {folder / name for folder in list(folders) for name in subfolders if name}
    largest = max(sum(1 for _ in root.iter()) for root in pages.values())
    total = 0
    for page, root in pages.items():
        for element, copies in _elements(root):
            total += copies * (largest if element.tag == "attach" else 1)
            if total > MOST_ELEMENTS:
                expected = f"at most {MOST_ELEMENTS} elements in all"
                raise invalid_value(str(page), f"<{element.tag}>", f"{copies} copies", expected)
            if element.tag == "attach" and page != path:
                expected = "attached models that attach no others"
                raise invalid_value(str(page), "<attach>", element.get("model"), expected)
            _check_figures(str(page), element)
            _check_assets(str(page), element, folders)


def _read_pages(path: Path, main: Path, pages: dict[Path, Element]) -> None:
    """Read a file and the files that it includes or attaches; MuJoCo looks for them beside the main file."""
    pages[path] = root = _parsed(path)
    for element in root.iter():
        file = element.get("file")
        if element.tag in ("include", "model") and file:
            for other in {main / file, path.parent / file}:
                if len(pages) >= MOST_FILES:
                    raise invalid_value(str(path), f"<{element.tag} file>", file, f"at most {MOST_FILES} files")
                if other not in pages and os.path.lexists(other):  # MuJoCo reports the others
                    _read_pages(other, main, pages)


def _parsed(path: Path) -> Element:
    text = read_bytes(path, "an MJCF file").decode("utf-8", "replace").removeprefix("\ufeff").replace("\r\n", "\n")
    if "<!DOCTYPE" in text:
        raise RobotError(f"{path}: there is a <!DOCTYPE>: expected MJCF without document type and entities")
    text = _without(_without(text, "<!--", "-->"), "<?", "?>")  # MuJoCo takes comments that XML does not allow
    if "\ufffd" in text:
        raise RobotError(f"{path}: cannot be read: expected an MJCF file in UTF-8, comments apart")
    start = re.search(r"<([^\s/>]*)", text)
    if start is None or start[1] not in ("mujoco", "mujocoinclude"):
        raise invalid_value(str(path), "root element", start and start[1], "<mujoco>")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise RobotError(f"{path}: malformed XML: expected an MJCF file ({one_line(error)})") from None


def _without(text: str, opening: str, closing: str) -> str:
    """Return text without what stands between an opening and a closing mark."""
    first, *rest = text.split(opening)
    return first + "".join(part.partition(closing)[2] for part in rest)


def _all(pages: dict[Path, Element], tag: str) -> Iterator[Element]:
    return (element for root in pages.values() for element in root.iter(tag))


def _elements(root: Element) -> Iterator[tuple[Element, int]]:
    """Iterate over all elements with how many copies there will be of each."""
    waiting = [(root, 1)]
    while waiting:
        element, copies = waiting.pop()
        if element.tag in _COPIES:
            copies *= max(1, math.prod(int(word) for word in _words(element, "count") if _whole(word)))
        yield element, copies
        waiting += [(child, copies) for child in element]


def _words(element: Element, key: str) -> list[str]:
    return element.get(key, "").lower().split()


def _whole(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) < 20


def _check_figures(file: str, element: Element) -> None:
    for key, value in element.items():
        words = value.lower().split()
        largest = LARGEST_SIZE if key in _SIZES else _LARGEST.get(key, LARGEST_SIZE) if element.tag == "size" else None
        if largest is not None and any(word.isdigit() and (len(word) > 9 or int(word) > largest) for word in words):
            raise invalid_value(file, key, value, f"at most {largest}")
        if key != "name" and any(word.lstrip("+-") == "nan" for word in words):
            raise invalid_value(file, key, value, "finite numbers")
        if key.endswith("range"):
            _check_range(file, f"<{element.tag}> {key}", value)
    for keys in _PAIRS:
        sides = [int(word) for key in keys for word in _words(element, key) if _whole(word)]
        if math.prod(sides) > LARGEST_PICTURE:
            expected = f"at most {LARGEST_PICTURE} together"
            raise invalid_value(file, f"<{element.tag}> {' x '.join(keys)}", sides, expected)
    memory = element.get("memory", "").upper()
    digits, unit = memory.rstrip("KMGTPE"), memory[-1:]
    if element.tag == "size" and _whole(digits) and int(digits) * _UNITS.get(unit, 1) > LARGEST_MEMORY:
        raise invalid_value(file, "<size> memory", memory, f"at most {LARGEST_MEMORY} bytes")


def _check_range(file: str, key: str, value: str) -> None:
    """Check that a range is not empty: MuJoCo would ignore it."""
    try:
        low, high = (float(word) for word in value.split())
    except ValueError:
        return  # MuJoCo reports the error
    if low > high:
        raise invalid_value(file, key, value, "a lower limit that is not above the upper")


def _check_assets(file: str, element: Element, folders: set[Path]) -> None:
    """Check that every file that MuJoCo may read for an asset is a regular file."""
    for key, value in element.items():
        if not key.startswith("file") or element.tag in ("include", "model"):
            continue
        for path in {folder / name for folder in folders for name in (value, Path(value).name)}:
            try:
                status = path.stat()
            except (OSError, ValueError):
                continue  # MuJoCo reports missing files
            check_regular(f"{file}: <{element.tag} {key}>: {path}", status, "a regular file", LARGEST_ASSET)
