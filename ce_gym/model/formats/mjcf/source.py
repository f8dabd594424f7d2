# pyright: reportAttributeAccessIssue=false
"""A compiled MJCF file: the one object that the parts of the MJCF reader share.

Knows the Python API of `mujoco`, which is imported only when a file is read; not the robot description beyond plain
poses. (MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Placement
from ce_gym.model.errors import RobotError, bad
from ce_gym.model.formats.placement import exact_right_angles, vec3

LARGEST_SIZE = 10_000
"""Largest number of copies, rows or pixels that an element may ask for; MuJoCo's compiler would try any."""

_SIZES = ("count", "nrow", "ncol", "width", "height", "gridsize")
_FIGURES = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_inertia", "body_mass"),
    *("jnt_pos", "jnt_axis", "jnt_range", "qpos0", "site_pos", "site_quat"),
    *("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_rgba"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
)


@dataclass
class MjcfSource:
    """A compiled file, and what has been found in it that cannot be represented.

    Attributes:
        file: Name of the file, for messages.
        mujoco: The package.
        model: `MjModel`.
        data: `MjData` at the reference pose: the first keyframe, or all joints at their `ref`.
        left_out: What the robot will lack; each entry completes "... is left out".
    """

    file: str
    mujoco: Any
    model: Any
    data: Any
    left_out: list[str] = field(default_factory=list)

    def name(self, kind: str, index: int) -> str:
        """Return the name of element `index` of a kind, such as "body"; one like "body3" if it has none."""
        return getattr(self.model, kind)(int(index)).name or f"{kind}{index}"

    def enabled(self, feature: str) -> bool:
        """Whether a part of the physics, such as "GRAVITY", is not switched off in the file's <option>."""
        return not self.model.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{feature}"))

    def forward(self) -> None:
        """Compute everything that follows from the reference pose."""
        with _without_log(self.mujoco):
            self.mujoco.mj_forward(self.model, self.data)


def read_mjcf(path: Path) -> MjcfSource:
    """Compile a file with MuJoCo.

    Raises:
        RobotError: `mujoco` is not installed, or it refuses the file.
    """
    _refuse_early(path)
    try:
        import mujoco
    except ImportError:
        raise RobotError(f"{path}: MJCF is read by MuJoCo: expected the package; pip install 'ce_gym[mjcf]'") from None
    try:
        with _without_log(mujoco):
            model = mujoco.MjModel.from_xml_path(str(path))
            source = MjcfSource(str(path), mujoco, model, mujoco.MjData(model))
    except Exception as error:  # MuJoCo raises ValueError, FatalError, MemoryError and others
        raise RobotError(f"{path}: MuJoCo refuses the file: expected valid MJCF ({_one_line(error)})") from None
    _refuse_nonfinite(str(path), model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, source.data, 0)
    source.forward()
    return source


@contextmanager
def _without_log(mujoco: Any) -> Iterator[None]:
    """Keep MuJoCo from writing its warnings, which are about simulating the file, to the terminal and a log file."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def _refuse_early(path: Path) -> None:
    """Refuse files that are no MJCF, and what MuJoCo would try to build without end or complain of on the terminal."""
    file = str(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise RobotError(f"{path}: cannot be read: expected an MJCF file ({_one_line(error)})") from None
    if "<!DOCTYPE" in text:
        raise RobotError(f"{path}: there is a <!DOCTYPE>: expected MJCF without document type and entities")
    text = re.sub(r"<!--.*?-->|<\?.*?\?>", "", text, flags=re.DOTALL)
    root = re.search(r"<([^\s/>]*)", text)
    if root is None or root[1] != "mujoco":
        raise bad(file, "root element", root and root[1], "<mujoco>")
    for key, value in re.findall(r"(\w+)\s*=\s*[\"']([^\"']*)", text):
        words = value.lower().split()
        if key in _SIZES and any(word.isdigit() and (len(word) > 9 or int(word) > LARGEST_SIZE) for word in words):
            raise bad(file, key, value, f"at most {LARGEST_SIZE}")
        if key != "name" and any(word.lstrip("+-") == "nan" for word in words):
            raise bad(file, key, value, "finite numbers")


def _refuse_nonfinite(file: str, model: Any) -> None:
    """Refuse figures that MuJoCo lets pass."""
    for name in _FIGURES:
        values = np.asarray(getattr(model, name))
        if not np.isfinite(values).all():
            raise bad(file, name, values[~np.isfinite(values)][0], "finite numbers")
    if (model.dof_armature < 0.0).any():
        raise bad(file, "armature", float(model.dof_armature.min()), "0 or more [kg m^2 or kg]")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def placement(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Placement:
    """Return a pose from MuJoCo's position [m] and quaternion (w, x, y, z)."""
    return Placement(vec3(position), exact_right_angles(rotation(quaternion)))


def rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix, shape (3, 3), of a quaternion (w, x, y, z) of any length but 0."""
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
