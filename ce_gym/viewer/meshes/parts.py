"""Files that a mesh file names, such as the buffers of a .gltf file, and how much it asks for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ce_gym.model.formats.text_file import check_regular

LARGEST = 2**27  # file [bytes]


class Beside:
    """What trimesh asks for other files: those in the folder of a mesh file or below, regular ones of limited size."""

    def __init__(self, mesh: Path) -> None:
        self.folder = mesh.parent.resolve()

    def get(self, name: str) -> bytes:
        """Return the bytes of a file.

        Raises:
            ValueError: It is elsewhere, no regular file, or too large.
        """
        path = next((one for one in (self.folder / name, self.folder / unquote(name)) if one.is_file()), None)
        if path is None or not path.resolve().is_relative_to(self.folder):
            raise ValueError(f"{name!r} is not in the folder of the mesh")
        check_regular(str(path), path.stat(), "a regular file", LARGEST)
        return path.read_bytes()

    __getitem__ = get

    def namespaced(self, namespace: str) -> Beside:
        """Return the same for a folder below."""
        return Beside(self.folder / namespace / "mesh")


def check_gltf(file: Path) -> None:
    """Check that a .glb or .gltf file asks for no more numbers than a file could hold.

    Raises:
        ValueError: It does, or it is not glTF.
    """
    content = file.read_bytes()
    if content[:4] == b"glTF":  # header of 12 bytes, then length and kind of the first chunk, which is JSON
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    tree: Any = json.loads(content)
    accessors = tree.get("accessors", []) if isinstance(tree, dict) else []
    if sum(int(one.get("count", 0)) for one in accessors) > LARGEST // 4:
        raise ValueError(f"more numbers than a file of {LARGEST} bytes has")
