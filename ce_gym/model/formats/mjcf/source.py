# pyright: reportAttributeAccessIssue=false
"""A compiled MJCF file, shared by the parts of the MJCF reader.

`mujoco` is imported only when a file is read. Its compiled modules have no types, which explains the line above.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.checks.robot import MOST_BODIES
from ce_gym.model.errors import RobotError, invalid_value, printable
from ce_gym.model.formats.mjcf.limits import check_file
from ce_gym.model.formats.mjcf.scenes import scene_hint
from ce_gym.model.formats.placement import exact_right_angles, vec3
from ce_gym.model.formats.text_file import one_line
from ce_gym.model.frames import Placement, rotation_matrix
from ce_gym.model.ranges import LARGEST_FIGURE

MOST_KINDS, MOST_NAMES = 8, 3
"""Number of kinds, and of names of each kind, in a summary of ignored parts."""

_FIGURES = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_inertia", "body_mass"),
    *("jnt_pos", "jnt_axis", "jnt_range", "qpos0", "site_pos", "site_quat"),
    *("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_rgba"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
    *("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness", "qpos_spring", "eq_data", "tendon_length0"),
)
_LIMITS = ("jnt_range", "actuator_forcerange")


@dataclass
class MjcfSource:
    """A compiled file, and its parts that have no counterpart in a robot.

    Attributes:
        file: Name of the file, for messages.
        mujoco: The package.
        model: `MjModel`.
        data: `MjData` at the reference pose: the first keyframe, or all joints at their `ref`.
        left_out: Ignored parts of the file: a text to complete "left out: ...", and the name to put in it.
        notes: Other notes for users.
        moved: Whether joints were moved to within their limits, which invalidates the height of the base.
    """

    file: str
    mujoco: Any
    model: Any
    data: Any
    left_out: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    moved: bool = False

    def name(self, kind: str, index: int) -> str:
        """Return the name of element `index` of a kind, such as "body"; a name like "body3" without a name."""
        return self.given_name(kind, index) or self._unused(kind, f"{kind}{index}")

    def given_name(self, kind: str, index: int) -> str:
        """Return the name of an element in the file; "" without a name."""
        return printable(getattr(self.model, kind)(int(index)).name)

    def _unused(self, kind: str, name: str) -> str:
        """Return a name that no element of a kind has, with underscores added if necessary."""
        try:
            getattr(self.model, kind)(name)
        except KeyError:
            return name
        return self._unused(kind, f"{name}_")

    def leave_out(self, what: str, name: str = "") -> None:
        """Note an ignored part of the file; `{}` in the text stands for the name of an element."""
        self.left_out.append((what, name))

    def enabled(self, feature: str) -> bool:
        """Whether a part of the physics, such as "GRAVITY", is not switched off in the file's <option>."""
        return not self.model.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{feature}"))

    def forward(self) -> None:
        """Compute the kinematics and constraints of the reference pose, without contacts."""
        options = self.model.opt
        flags = options.disableflags
        options.disableflags = flags | int(self.mujoco.mjtDisableBit.mjDSBL_CONTACT)
        with _without_log(self.mujoco):
            self.mujoco.mj_forward(self.model, self.data)
        options.disableflags = flags


def summary(left_out: list[tuple[str, str]]) -> str:
    """Return the ignored parts in one line: each kind once, with a few names."""
    kinds: dict[str, list[str]] = {}
    for what, name in left_out:
        kinds.setdefault(what, []).append(name)
    parts = []
    for what, names in list(kinds.items())[:MOST_KINDS]:
        rest = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        parts.append(what.format(", ".join(names[:MOST_NAMES]) + rest))
    if len(kinds) > MOST_KINDS:
        parts.append(f"{len(kinds) - MOST_KINDS} other kinds of things")
    return "; ".join(parts) + (" (Robot.notes has all)" if len(left_out) > len(parts) else "")


def read_mjcf(path: Path) -> MjcfSource:
    """Compile a file with MuJoCo.

    Raises:
        RobotError: `mujoco` is not installed, or refuses the file.
    """
    check_file(path)
    try:
        import mujoco
    except ImportError:
        raise RobotError(f"{path}: MJCF is read by MuJoCo: expected the package; pip install 'ce_gym[mjcf]'") from None
    try:
        model = _compiled(mujoco, path)
        source = MjcfSource(str(path), mujoco, model, mujoco.MjData(model))
    except Exception as error:  # MuJoCo raises ValueError, FatalError, MemoryError and others
        message = f"{path}: MuJoCo refuses the file: expected valid MJCF ({one_line(error)})"
        raise RobotError(message + scene_hint(path, lambda other: _is_readable(mujoco, other))) from None
    _check_figures(str(path), model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, source.data, 0)
    elif not model.neq:  # loops would come apart
        _move_within_limits(source)
    source.forward()
    return source


def _compiled(mujoco: Any, path: Path) -> Any:
    with _without_log(mujoco):
        model = mujoco.MjModel.from_xml_path(str(path))
    _switch_off(mujoco, model)
    return model


def _is_readable(mujoco: Any, path: Path) -> bool:
    try:
        check_file(path)
        _compiled(mujoco, path)
    except Exception:  # as above
        return False
    return True


def _switch_off(mujoco: Any, model: Any) -> None:
    """Set parameters to zero that a <flag> of the file disables; not gravity, contacts or actuators, see `enabled`."""
    for features, figures in (
        (("CONSTRAINT", "FRICTIONLOSS"), ("dof_frictionloss", "tendon_frictionloss")),
        (("CONSTRAINT", "LIMIT"), ("jnt_limited", "tendon_limited")),
        (("CONSTRAINT", "EQUALITY"), ("eq_active0",)),
        (("PASSIVE", "SPRING"), ("jnt_stiffness", "tendon_stiffness")),  # PASSIVE: before MuJoCo 3.4
        (("PASSIVE", "DAMPER"), ("dof_damping", "tendon_damping")),
    ):
        bits = [int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{feature}", 0)) for feature in features]
        if any(model.opt.disableflags & bit for bit in bits):
            for figure in figures:
                getattr(model, figure)[:] = 0


def _move_within_limits(source: MjcfSource) -> None:
    """Move joints of a reference pose that nobody chose, all at `ref`, to within their limits."""
    model, kinds = source.model, source.mujoco.mjtJoint
    for j in range(model.njnt):
        if model.jnt_limited[j] and int(model.jnt_type[j]) in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
            address = model.jnt_qposadr[j]
            before = source.data.qpos[address]
            source.data.qpos[address] = np.clip(before, *model.jnt_range[j])
            if abs(source.data.qpos[address] - before) > 1e-6:
                source.moved = True
                body = source.name("body", model.jnt_bodyid[j])
                source.leave_out("the angle in the reference pose, beyond its limits, of {}", body)


@contextmanager
def _without_log(mujoco: Any) -> Iterator[None]:
    """Keep MuJoCo from writing its warnings, which are about simulating the file, to the terminal and a log file."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def _check_figures(file: str, model: Any) -> None:
    """Refuse numbers that MuJoCo accepts but no robot can have, and robots of too many bodies."""
    for name in _FIGURES:
        values = np.asarray(getattr(model, name))
        usable = np.isfinite(values) & ((np.abs(values) <= LARGEST_FIGURE) | (name in _LIMITS))
        if not usable.all():
            expected = f"finite numbers, up to {LARGEST_FIGURE:g} in size"
            raise invalid_value(file, name, float(values[~usable][0]), expected)
    if (model.dof_armature < 0.0).any():
        raise invalid_value(file, "armature", float(model.dof_armature.min()), "0 or more [kg m^2 or kg]")
    if max(model.nbody - 1, model.nv) > MOST_BODIES:
        found = f"{model.nbody - 1} bodies with {model.nv} degrees of freedom"
        raise invalid_value(file, "size", found, f"at most {MOST_BODIES} of each")


def placement(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Placement:
    """Return a pose from MuJoCo's position [m] and quaternion (w, x, y, z)."""
    return Placement(vec3(position), exact_right_angles(rotation(quaternion)))


def quaternion(values: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return a quaternion (w, x, y, z) of MuJoCo's with length 1."""
    w, x, y, z = (float(value) for value in values / np.linalg.norm(values))
    return (w, x, y, z)


def rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix, shape (3, 3), of a quaternion (w, x, y, z) of any length but 0."""
    return rotation_matrix(np.asarray(quaternion) / np.linalg.norm(quaternion))
