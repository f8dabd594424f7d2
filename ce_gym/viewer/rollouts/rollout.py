"""Recorded rollouts: the motion of a robot, frame by frame, and its file.

A rollout contains the robot's name and arrays; the viewer computes the poses of bodies from them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.files import ROLLOUT, written
from ce_gym.model.formats.archive import read_npz
from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.rollouts.ground_patch import Heights

FORMAT = "ce_gym rollout"
VERSION = 3
MOST_BYTES = 2**30  # of a rollout in memory; an hour of a humanoid at 50 frames per second takes a tenth

ARRAYS = {"times": 1, "q": 2, "v": 2, "contact_forces": 3, "commands": 2, "torques": 2, "signals": 2}
"""Number of axes of each array of a rollout; the first axis is time."""

HEADER: dict[str, Any] = {
    "robot": str,
    "transmission": str,
    "dt": int | float,
    "label": str,
    "info": dict,
    "contact_names": list,
    "signal_names": list,
}
"""Type of each entry of a file's header."""

Array = NDArray[np.float64]


class RolloutError(ValueError):
    """A rollout or its file is invalid; the message is one line."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """States of one robot at T frames.

    Attributes:
        robot: Name of a robot, or path of its file.
        transmission: Transmission level of the simulation.
        dt: Time between frames [s].
        times: Time of each frame, strictly increasing [s], shape (T,).
        q: Positions, shape (T, nq).
        v: Velocities, shape (T, nv).
        contact_forces: Force of the ground on each contact, world axes [N], shape (T, n_contacts, 3); n_contacts may
            be zero. None means zero contacts.
        commands: Commands, shape (T, n); n may be zero. The first two columns are drawn as speed forward and to the
            left in the frame of the base's heading [m/s]. None means n = 0.
        torques: Motor torque at each independent joint over the control step before the frame [N m], shape
            (T, n_joints); n_joints may be zero. None means n_joints = 0.
        signals: Further signals to plot, such as reward terms, shape (T, n). None means n = 0.
        signal_names: Names of the columns of `signals`.
        label: A few words for the legend.
        info: Further entries, as text.
        contact_names: Names of the contacts of the forces; empty for all contacts of the robot, in its order.
        ground: The ground around the robot's path, see `rollouts.ground_patch.around`; None if flat.
        scan: The robot's scans, a mapping for each. The sensor sits on `link` ("" for the base) at the mean of the
            places `at` in the link's frame [m]. A height scan has `points`: pairs of distances ahead and to the left
            [m], which turn with the base's heading. A range scan has `rays`: unit vectors in the link's frame, with
            their length `reach` [m] and the number of `steps` along them.
    """

    robot: str
    transmission: str
    dt: float
    times: Array
    q: Array
    v: Array
    contact_forces: Array = None  # type: ignore[assignment]  # __post_init__ turns None into an empty array
    commands: Array = None  # type: ignore[assignment]
    torques: Array = None  # type: ignore[assignment]
    signals: Array = None  # type: ignore[assignment]
    signal_names: Sequence[str] = ()
    label: str = ""
    info: Mapping[str, str] = field(default_factory=dict)
    contact_names: Sequence[str] = ()
    ground: Terrain | None = None
    scan: Sequence[Any] = ()

    def __post_init__(self) -> None:
        frames = np.size(self.times)
        empty: dict[str, Array] = {name: np.empty((frames, 0)) for name in ("commands", "torques", "signals")}
        empty["contact_forces"] = np.empty((frames, 0, 3))
        for name, ndim in ARRAYS.items():
            value = getattr(self, name)
            value = _numbers(name, empty[name] if value is None and name in empty else value)
            object.__setattr__(self, name, value)
            _check_array(name, value, ndim, frames)
        _check_clock(self.dt, self.times)
        if self.contact_forces.shape[2] != 3:
            raise RolloutError(f"contact_forces has shape {self.contact_forces.shape}; expected (T, n_contacts, 3)")
        object.__setattr__(self, "contact_names", tuple(self.contact_names))
        names, contacts = len(self.contact_names), self.contact_forces.shape[1]
        if names and contacts and names != contacts:
            raise RolloutError(f"contact_names has {names} names; contact_forces has {contacts} contacts")
        object.__setattr__(self, "signal_names", tuple(self.signal_names))
        object.__setattr__(self, "scan", tuple(_scan(scan) for scan in self.scan))
        if len(self.signal_names) != self.signals.shape[1]:
            raise RolloutError(
                f"signal_names has {len(self.signal_names)} names; signals has {self.signals.shape[1]} columns"
            )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return float(self.times[-1] - self.times[0])

    def save(self, path: str | Path) -> Path:
        """Write the rollout as a compressed npz in single precision, and return its path.

        Examples:
            >>> still = Rollout("four_bar", "exact", dt=0.02, times=[0.0, 0.02], q=[[1.5], [1.5]], v=[[0.0], [0.0]])
            >>> Rollout.load(still.save("still.npz")).duration
            0.02
        """
        header = {
            "format": FORMAT,
            "version": VERSION,
            "robot": self.robot,
            "transmission": self.transmission,
            "dt": float(self.dt),
            "label": self.label,
            "info": {str(key): str(value) for key, value in self.info.items()},
            "contact_names": list(self.contact_names),
            "signal_names": list(self.signal_names),
            "scans": list(self.scan),
        }
        ground: dict[str, Any] = {}
        if self.ground is not None:
            ground["ground"], low, step = Heights.of(self.ground)
            header["ground"] = {"cell": self.ground.cell, "origin": self.ground.origin, "low": low, "step": step}
        path = Path(path)
        # numpy would append .npz to a name without.
        with written(path, ROLLOUT) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                header=np.array(json.dumps(header)),
                times=self.times,
                **{name: getattr(self, name).astype(np.float32) for name in ARRAYS if name != "times"},
                **ground,
            )
        return path

    @classmethod
    def load(cls, path: str | Path) -> Rollout:
        """Read a file of `save`.

        Raises:
            RolloutError: The file is missing, damaged, of another kind or of another version.
        """
        entries = _read_entries(Path(path))
        try:
            header = _read_header(entries.pop("header"))
            ground = _read_ground(header.pop("ground"), entries.get("ground"))
            if missing := [name for name in ARRAYS if name not in entries]:
                raise RolloutError(f"has no {', '.join(missing)}; expected {', '.join(ARRAYS)}")
            return cls(**header, **{name: entries[name] for name in ARRAYS}, ground=ground)
        except RolloutError as error:
            raise RolloutError(f"{path}: {error}") from None


def _numbers(name: str, value: Any) -> Array:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise RolloutError(f"{name} is not an array of numbers") from None


def _scan(scan: Any) -> dict[str, Any]:
    """Return one scan as plain data, checked."""
    if not isinstance(scan, Mapping):
        raise RolloutError(f"scan: {type(scan).__name__}; expected a mapping")
    has_rays = "rays" in scan
    checked: dict[str, Any] = {"link": str(scan.get("link", ""))}
    for name, size in (("at", 3), ("rays", 3) if has_rays else ("points", 2)):
        rows = _numbers("scan", scan.get(name, ()))
        if rows.ndim != 2 or rows.shape[1] != size or not np.isfinite(rows).all():
            raise RolloutError(f"scan: {name} has shape {rows.shape}; expected rows of {size} finite numbers")
        checked[name] = rows.tolist()
    for name in ("reach", "steps") if has_rays else ():
        if not (isinstance(scan.get(name), int | float) and 0 < scan[name] <= 1e4):
            raise RolloutError(f"scan: {name} is {scan.get(name)!r}; expected a number above 0, at most 10000")
        checked[name] = scan[name]
    return checked


def _check_array(name: str, value: Array, ndim: int, frames: int) -> None:
    if frames == 0:
        raise RolloutError("times is empty: expected at least one frame")
    if value.ndim != ndim or len(value) != frames:
        expected = "(T,)" if ndim == 1 else f"{ndim} axes, the first of length {frames} as in times"
        raise RolloutError(f"{name} has shape {value.shape}; expected {expected}")
    if not np.isfinite(value).all():
        frame = int(np.argwhere(~np.isfinite(value))[0][0])
        raise RolloutError(f"{name} has a number that is not finite in frame {frame}; expected finite numbers")


def _check_clock(dt: float, times: Array) -> None:
    if not (np.isfinite(dt) and dt > 0):
        raise RolloutError(f"dt is {dt}; expected a positive time in seconds")
    if (np.diff(times) <= 0).any():
        raise RolloutError("times does not increase from frame to frame")


def _read_entries(path: Path) -> dict[str, Any]:
    try:
        entries = read_npz(path, MOST_BYTES)
    except FileNotFoundError:
        raise RolloutError(f"{path}: no such file; expected a rollout (.npz)") from None
    except Exception as error:  # damaged files raise errors of many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RolloutError(f"{path}: cannot be read as a rollout ({reason})") from None
    if "header" not in entries:
        raise RolloutError(f"{path}: not a ce_gym rollout; expected an npz with an entry 'header'")
    return entries


def _read_header(entry: NDArray[Any]) -> dict[str, Any]:
    try:
        header = json.loads(str(entry))
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.pop("format", None) != FORMAT:
        raise RolloutError(f"not a ce_gym rollout; expected a header with format {FORMAT!r}")
    version = header.pop("version", None)
    if version != VERSION:
        raise RolloutError(f"version is {version!r}; expected {VERSION}")
    for key, kind in HEADER.items():
        if not isinstance(header.get(key), kind):
            name = "a number" if kind == int | float else kind.__name__
            raise RolloutError(f"header key {key!r} is {header.get(key)!r}; expected {name}")
    return {key: header[key] for key in HEADER} | {"ground": header.get("ground"), "scan": header.get("scans", [])}


def _read_ground(header: Any, numbers: Any) -> Terrain | None:
    """Return the ground from its entry of the header and its heights; None without such an entry."""
    if header is None:
        return None
    try:
        if numbers.dtype != np.uint16:
            raise RolloutError(f"ground has numbers of type {numbers.dtype}; expected uint16")
        heights = Heights(numbers, float(header["low"]), float(header["step"])).metres()
        return Terrain(heights, header["cell"], header["origin"])
    except RolloutError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RolloutError(f"ground is damaged ({error}); expected heights with cell, origin, low and step") from None
