"""three.js objects, meshcat commands and animation tracks, as plain dictionaries.

meshcat's page takes commands (`set_object`, `set_property`, `set_animation`) packed with MessagePack. Unlike meshcat's
Python classes these functions need no server, give identical bytes for identical scenes, and have capsules, lights with
shadows and packed animation tracks. Formats: three.js r132, which meshcat 0.3.2 contains, and meshcat's `commands.py`.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.viewer.errors import ViewerError

Array = NDArray[np.float64]
Command = dict[str, Any]
Color = Sequence[float]

_EXTENSIONS = {"u2": 0x14, "u4": 0x16, "f4": 0x17}  # MessagePack codes of typed arrays in meshcat's page
FRONT, BACK = 0, 1  # three.js: which faces of a mesh are drawn
_REPEAT, _LINEAR, _LINEAR_MIPMAP = 1000, 1006, 1008  # three.js texture constants


def pack(command: Command) -> bytes:
    """Return a command as the MessagePack bytes that meshcat's page reads."""
    try:
        import umsgpack
    except ImportError:
        raise ViewerError.missing("meshcat") from None

    def pack_array(array: NDArray[Any]) -> Any:
        kind = array.dtype.str[1:] if array.dtype.kind == "u" else "f4"
        return umsgpack.Ext(_EXTENSIONS[kind], np.ascontiguousarray(array, dtype=f"<{kind}").tobytes())

    return umsgpack.packb(command, ext_handlers={np.ndarray: pack_array})


def hex_color(color: Color) -> int:
    """Return red, green, blue in 0..1 as 0xrrggbb."""
    red, green, blue = (round(255 * min(max(float(c), 0.0), 1.0)) for c in color[:3])
    return red << 16 | green << 8 | blue


def transform(position: ArrayLike = (0, 0, 0), rotation: ArrayLike | None = None) -> Array:
    """Return the (4, 4) matrix of a pose."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix


# The axis of three.js cylinders, lathes and spheres is y; this package uses z.
Y_TO_Z = transform(rotation=[[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def set_object(path: str, kind: str, matrix: Array, **parts: Any) -> Command:
    """Return the command that puts one three.js object at a path.

    Args:
        path: Scene path.
        kind: three.js type, such as "Mesh".
        matrix: Pose in the frame of the path, shape (4, 4).
        parts: "geometry", "material", "texture" and "image" become resources named after the path; other parts are
            properties of the object.
    """
    scene: Command = {"metadata": {"version": 4.5, "type": "Object"}}
    item: Command = {"uuid": path, "type": kind, "matrix": matrix.T.ravel().tolist()}
    resources = {"geometry": "geometries", "material": "materials", "texture": "textures", "image": "images"}
    for name, value in parts.items():
        if name not in resources:
            item[name] = value
            continue
        scene[resources[name]] = [{"uuid": f"{path}:{name}", **value}]
        if name in ("geometry", "material"):
            item[name] = f"{path}:{name}"
    return {"type": "set_object", "path": path, "object": {**scene, "object": item}}


def mesh(
    path: str, geometry: Command, color: Color, matrix: Array, *, opacity: float = 1.0, flat: bool = False
) -> Command:
    """Return the command that draws a solid; `flat` gives each triangle its own normal, which keeps edges sharp."""
    material: Command = {
        "type": "MeshStandardMaterial",
        "color": hex_color(color),
        "roughness": 0.55,
        "metalness": 0.1,
        "side": FRONT,
        "transparent": opacity < 1,
        "opacity": float(opacity),
        **({"flatShading": True} if flat else {}),
    }
    return set_object(path, "Mesh", matrix, geometry=geometry, material=material)


def textured(path: str, geometry: Command, pixels: NDArray[np.uint8], matrix: Array, **options: Any) -> Command:
    """Return the command that draws a solid covered by an image.

    Args:
        path: Scene path.
        geometry: The solid, such as `box(...)`.
        pixels: Red, green, blue, shape (height, width, 3).
        matrix: Pose, shape (4, 4).
        options: "repeat" (repetitions along both edges, default (1, 1)); "userData", for scripts of the page; other
            options belong to the material.
    """
    user_data = {"userData": options.pop("userData")} if "userData" in options else {}
    repeat = [float(times) for times in options.pop("repeat", (1, 1))]
    texture = {
        "image": f"{path}:image",
        "wrap": [_REPEAT, _REPEAT],
        "repeat": repeat,
        "minFilter": _LINEAR_MIPMAP,
        "magFilter": _LINEAR,
        "anisotropy": 8,
    }
    url = "data:image/png;base64," + base64.b64encode(png(pixels)).decode()
    material = {"map": f"{path}:texture", "color": 0xFFFFFF, **options}
    parts = {"geometry": geometry, "material": material, "texture": texture, "image": {"url": url}}
    return set_object(path, "Mesh", matrix, **parts, **user_data)


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return an image, shape (height, width, 3), as a PNG file (RFC 2083)."""
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in np.ascontiguousarray(pixels))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(rows, 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def set_transform(path: str, matrix: Array) -> Command:
    """Return the command that sets the pose of a path; `matrix` has shape (4, 4)."""
    return {"type": "set_transform", "path": path, "matrix": matrix.T.ravel().tolist()}


def set_property(path: str, name: str, value: Any) -> Command:
    """Return the command that sets a property of the object at a path."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def box(x: float, y: float, z: float) -> Command:
    """Return a box with edges along the axes [m]."""
    return {"type": "BoxGeometry", "width": float(x), "height": float(y), "depth": float(z)}


def sphere(radius: float) -> Command:
    """Return a sphere [m]."""
    return {"type": "SphereGeometry", "radius": float(radius), "widthSegments": 32, "heightSegments": 20}


def cylinder(radius: float, length: float, *, top: float | None = None) -> Command:
    """Return a cylinder about y [m]; `top` is the radius at +y if different, zero for a cone."""
    radii = {"radiusTop": float(radius if top is None else top), "radiusBottom": float(radius)}
    return {"type": "CylinderGeometry", **radii, "height": float(length), "radialSegments": 40}


def capsule(radius: float, length: float) -> Command:
    """Return a capsule about y; `length` is the distance between the centres of its ends [m]."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 22)
    heights = radius * np.sin(angles) + np.where(angles > 0, 0.5, -0.5) * length
    points = [{"x": float(x), "y": float(y)} for x, y in zip(radius * np.cos(angles), heights, strict=True)]
    return {"type": "LatheGeometry", "points": points, "segments": 32, "phiStart": 0.0, "phiLength": 2 * np.pi}


def triangles(vertices: Array, faces: NDArray[Any]) -> Command:
    """Return triangles `faces`, shape (m, 3), between `vertices`, shape (n, 3) [m]."""
    small = len(vertices) < 2**16
    index = {
        "type": f"Uint{16 if small else 32}Array",
        "array": faces.ravel().astype(np.uint16 if small else np.uint32),
    }
    position = {"itemSize": 3, "type": "Float32Array", "array": vertices.ravel(), "normalized": False}
    return {"type": "BufferGeometry", "data": {"attributes": {"position": position}, "index": index}}


def plane(x: float, y: float) -> Command:
    """Return a rectangle in the xy plane that faces +z [m]."""
    return {"type": "PlaneGeometry", "width": float(x), "height": float(y)}


def quaternions(rotations: Array) -> Array:
    """Return quaternions in three.js order (x, y, z, w), shape (..., 4), of rotation matrices, shape (..., 3, 3).

    Shepperd's method (1978): of four formulas the one with the largest divisor is used.
    """
    r = rotations
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    trace = diagonal.sum(-1)
    off = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    candidates = np.empty((*r.shape[:-2], 4, 4))
    candidates[..., :3, :3] = r + np.swapaxes(r, -1, -2)
    candidates[..., [0, 1, 2], [0, 1, 2]] = 1 + 2 * diagonal - trace[..., None]
    candidates[..., :3, 3] = candidates[..., 3, :3] = off
    candidates[..., 3, 3] = 1 + trace
    best = np.argmax(candidates[..., range(4), range(4)], -1)
    quaternion = np.take_along_axis(candidates, best[..., None, None], -2)[..., 0, :]
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def clip(path: str, times: Array, end: float, values: dict[str, Array]) -> Command:
    """Return the animation of one scene path, which holds its last value until `end` [s].

    Args:
        path: Scene path.
        times: [s], shape (T,).
        end: End of the animation [s].
        values: "position" and "scale", shape (T, 3), and "quaternion", shape (T, 4).
    """
    if times[-1] < end:
        times = np.append(times, end)
        values = {name: np.concatenate([value, value[-1:]]) for name, value in values.items()}
    tracks = [_track(name, times, value) for name, value in values.items()]
    return {"path": path, "clip": {"fps": 1, "name": path, "tracks": tracks}}  # fps 1: times are in seconds


def _track(name: str, times: Array, values: Array) -> Command:
    constant = np.abs(values - values[0]).max() < 1e-6
    keys = [0, -1] if constant else slice(None)
    kind = "quaternion" if name == "quaternion" else "vector3"
    return {"name": f".{name}", "type": kind, "times": times[keys], "values": values[keys].ravel()}


def set_animation(clips: list[Command]) -> Command:
    """Return the command that loads clips and plays them in a loop."""
    options = {"play": True, "repetitions": float("inf")}
    return {"type": "set_animation", "path": "", "animations": clips, "options": options}
