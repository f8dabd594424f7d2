"""Ground, sky, lights and camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.page import three
from ce_gym.viewer.page.three import Command
from ce_gym.viewer.rollouts.ground_patch import as_json

HORIZON = (0.91, 0.93, 0.95)
ZENITH = (0.50, 0.66, 0.82)
TILE = 1.0  # edge of the square that the ground's image repeats over [m]
GROUND_MARGIN = 45.0  # the sky's dome hides the ground beyond [m]
SKY_RADIUS = 45.0
FIELD_OF_VIEW = 35.0  # vertical [degrees]
VIEW = [0.62, -0.80, 0.30]  # from the robot towards the camera
SUN = [0.45, -0.55, 1.0]  # towards the sun
SCAN_COLOR = (0.80, 0.30, 0.75)
FADING = 0.4  # uneven ground fades into the horizon from this share of its radius on
STEEP = 0.5  # darkening of a vertical face of uneven ground, in addition to light and shadow

_MESHCAT_OWN = (
    "/Grid",
    "/Axes",
    "/Lights/SpotLight",
    "/Lights/PointLightNegativeX",
    "/Lights/PointLightPositiveX",
    "/Lights/AmbientLight",
    "/Lights/FillLight",
)


def surroundings(
    low: NDArray[np.float64], high: NDArray[np.float64], *, root: str, radius: float, flat: bool = True
) -> Iterator[Command]:
    """Return the commands that draw ground, sky and lights.

    Args:
        low: Smallest x and y that the robots visit [m].
        high: Largest x and y [m].
        root: Scene path of the robots' world; the ground belongs to it.
        radius: Radius of the robots [m].
        flat: Whether the ground is the plane z = 0; `field_command` draws uneven ground.
    """
    for path in _MESHCAT_OWN:
        yield three.set_property(path, "visible", False)
    if flat:
        yield _ground(f"{root}/ground", low, high)
    yield _sky("/sky")
    yield from _lights(radius)


def eye(radius: float) -> NDArray[np.float64]:
    """Return the camera's place for a ball of `radius` [m] around the origin [m], shape (3,)."""
    return 1.3 * radius / np.sin(np.radians(FIELD_OF_VIEW / 2)) * _unit(VIEW)


def camera_commands(place: NDArray[np.float64]) -> Iterator[Command]:
    """Look at the origin from a place [m], shape (3,). meshcat's camera always turns about the origin."""
    x, y, z = place.tolist()
    lens = "/Cameras/default/rotated/<object>"
    yield three.set_property(lens, "fov", FIELD_OF_VIEW)
    yield three.set_property(lens, "position", [x, z, -y])  # this node of meshcat's has y up


def field_command(
    path: str,
    ground: Terrain,
    bodies: Sequence[str],
    reach: float,
    fading: float = FADING,
    scans: Sequence[Mapping[str, Any]] = (),
) -> Command:
    """Return the command that draws uneven ground; `ground.js` computes its shape.

    Args:
        path: Scene path, in the frame of the robots' worlds.
        ground: A piece of the ground.
        bodies: Scene paths of the bodies around which the ground is drawn.
        reach: Radius of the drawn ground around each body [m].
        fading: The ground fades into the horizon from this share of `reach` on.
        scans: See `placed_scans`; points turn with the first body.
    """
    data = {**as_json(ground), "bodies": list(bodies), "reach": float(reach), "fading": fading, "steep": STEEP}
    if scans:
        data |= {"scans": list(scans), "color": three.hex_color(SCAN_COLOR)}
    return _tiled(path, three.plane(TILE, TILE), np.eye(4), userData={"field": data})


def _unit(vector: list[float]) -> NDArray[np.float64]:
    return np.array(vector) / np.linalg.norm(vector)


def _ground(path: str, low: NDArray[np.float64], high: NDArray[np.float64]) -> Command:
    # Corners at multiples of the tile keep the lines at whole metres of the world.
    first = np.floor(low - GROUND_MARGIN)
    edges = np.ceil(high + GROUND_MARGIN) - first
    pose = three.transform([*(first + edges / 2), 0.0])
    return _tiled(path, three.plane(*edges), pose, repeat=edges / TILE)


def _tiled(path: str, geometry: Command, pose: NDArray[np.float64], **options: Any) -> Command:
    look = {"type": "MeshStandardMaterial", "roughness": 1.0, "metalness": 0.0}
    return three.textured(path, geometry, ground_image(), pose, **look, **options)


def ground_image(size: int = 256) -> NDArray[np.uint8]:
    """Return one tile of the ground, shape (size, size, 3): four squares in two shades and thin lines."""
    light, dark, line = np.array([[228, 232, 236], [213, 219, 225], [190, 199, 208]], np.uint8)
    cell = np.arange(size) * 2 // size
    image = np.where(((cell[:, None] + cell) % 2)[..., None], light, dark)
    on_line = np.arange(size) % (size // 2) < max(size // 128, 1)
    image[on_line, :] = line
    image[:, on_line] = line
    return image


def _sky(path: str) -> Command:
    height = np.linspace(1, -1, 128)[:, None]  # top row is the zenith
    blend = np.clip(height, 0, 1) ** 0.6
    image = np.round(255 * (blend * ZENITH + (1 - blend) * HORIZON)).astype(np.uint8)
    dome = three.sphere(SKY_RADIUS)
    return three.textured(
        path, dome, image[:, None, :], three.Y_TO_Z, type="MeshBasicMaterial", side=three.BACK, fog=False
    )


def _lights(radius: float) -> Iterator[Command]:
    sky = {"color": 0xFFFFFF, "groundColor": three.hex_color((0.62, 0.62, 0.64)), "intensity": 0.5}
    yield three.set_object("/Lights/sky", "HemisphereLight", three.transform([0, 0, 1]), **sky)
    reach = 3.0 * radius
    frustum = {"left": -reach, "right": reach, "top": reach, "bottom": -reach, "near": 0.1, "far": 12.0 * radius}
    shadow = {
        "camera": {"uuid": "/Lights/sun:camera", "type": "OrthographicCamera", "zoom": 1, **frustum},
        "mapSize": [2048, 2048],
        "radius": 2.0,
        "bias": -0.0002,
        "normalBias": 3 * 2 * reach / 2048,  # three texels; with less, round bodies shade themselves in stripes
    }
    position = three.transform(6.0 * radius * _unit(SUN))
    yield three.set_object("/Lights/sun", "DirectionalLight", position, color=0xFFF6E8, intensity=0.56, shadow=shadow)
    fill = {"color": 0xDCE8FF, "intensity": 0.18}
    yield three.set_object("/Lights/fill", "DirectionalLight", three.transform([-3.0, 4.0, 2.0]), **fill)
    # In meshcat's page all lights cast shadows; here only the sun does.
    for path in ("/Lights/sky", "/Lights/fill"):
        yield three.set_property(f"{path}/<object>", "castShadow", False)
