"""Recorded rollouts: what a robot did, frame by frame, as one small file.

A rollout names its robot and holds arrays; poses of bodies are computed from it when it is shown.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.policies.archive import read_npz
from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.rollouts.ground_patch import Heights

FORMAT = "ce_gym rollout"
VERSION = 3
READABLE = (2, 3)  # version 2 knew no ground but the flat

MOST_BYTES = 2**30  # of a rollout in memory: an hour of a humanoid at 50 frames a second takes a tenth

ARRAYS = {"times": 1, "q": 2, "v": 2, "contact_forces": 3, "commands": 2, "torques": 2, "signals": 2}
"""What a rollout consists of: the number of axes of each array, the first of which is time."""

Array = NDArray[np.float64]


class RolloutError(ValueError):
    """A rollout, or a file that should hold one, is not usable; the message is one line."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """States of one robot at T frames.

    Attributes:
        robot: Name of a robot, or path of its file.
        transmission: Transmission level it was simulated with.
        dt: Time between frames [s].
        times: Time of each frame, strictly increasing [s], shape (T,).
        q: Positions, shape (T, nq).
        v: Velocities, shape (T, nv).
        contact_forces: Force of the ground on each contact, world axes [N], shape (T, n_contacts, 3); n_contacts may
            be zero. None means zero contacts.
        commands: The robot's commands, shape (T, n); n may be zero. The first two columns are drawn as
            speed forward and to the left in the frame of the base's heading [m/s]. None means n = 0.
        torques: Torque of the motors at each independent joint over the control step that led here [N m], shape
            (T, n_joints); n_joints may be zero. None means none.
        signals: Anything else to plot, such as reward terms, shape (T, n). None means n = 0.
        signal_names: Of the columns of `signals`.
        label: A few words for the legend.
        info: Anything else worth keeping, as text.
        contact_names: Which contacts the forces belong to, for simulations of some contacts only; empty means all of
            the robot's, in its order.
        ground: The ground around the robot's path, see `rollouts.ground_patch.around`; None if flat.
        scan: Where the robot's scans look, a mapping for each. `link` ("" for the base) has a sensor in the mean of the
            places `at`, in its frame [m]. It looks straight down on `points`, pairs ahead of and to the left of there
            [m], which turn with the base's heading; or along `rays`, unit vectors in the link's frame, `reach` [m] far
            in so many `steps`. Pairs alone are points about the base.
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
        named, found = len(self.contact_names), self.contact_forces.shape[1]
        if named and found and named != found:
            raise RolloutError(f"contact_names has {named} names; contact_forces has {found} contacts")
        object.__setattr__(self, "signal_names", tuple(self.signal_names))
        object.__setattr__(self, "scan", _scans(self.scan))
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
        """Write the rollout as a compressed npz, values in single precision, and return its path.

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
            **({"scans": list(self.scan)} if self.scan else {}),
        }
        ground: dict[str, Any] = {}
        if self.ground is not None:
            ground["ground"], low, step = Heights.of(self.ground)
            header["ground"] = {"cell": self.ground.cell, "origin": self.ground.origin, "low": low, "step": step}
        path = Path(path)
        # An open file, since numpy would append .npz to a name that lacks it.
        with path.open("wb") as file:
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
        """Read what `save` wrote.

        Raises:
            RolloutError: The file is missing, damaged, of another kind or of a newer version.
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


def _scans(given: Any) -> tuple[dict[str, Any], ...]:
    """Return scans as plain data, checked."""
    if not len(given):
        return ()
    if not isinstance(given[0], Mapping):
        given = [{"link": "", "at": [[0.0, 0.0, 0.0]], "points": given}]
    return tuple(_scan(one) for one in given)


def _scan(given: Mapping[str, Any]) -> dict[str, Any]:
    looks, march = ("rays", 3) if "rays" in given else ("points", 2), ("reach", "steps")
    found: dict[str, Any] = {"link": str(given.get("link", ""))}
    for name, size in (("at", 3), looks):
        rows = _numbers("scan", given.get(name, ()))
        if rows.ndim != 2 or rows.shape[1] != size or not np.isfinite(rows).all():
            raise RolloutError(f"scan: {name} has shape {rows.shape}; expected rows of {size} finite numbers")
        found[name] = rows.tolist()
    for name in march if "rays" in given else ():
        if not (isinstance(given.get(name), int | float) and 0 < given[name] <= 1e4):
            raise RolloutError(f"scan: {name} is {given.get(name)!r}; expected a number above 0, at most 10000")
        found[name] = given[name]
    return found


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
    except Exception as error:  # damage shows in every kind of them
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
    if version not in READABLE:
        raise RolloutError(f"version is {version!r}; this ce_gym reads versions {', '.join(map(str, READABLE))}")
    expected = {
        "robot": str,
        "transmission": str,
        "dt": (int, float),
        "label": str,
        "info": dict,
        "contact_names": list,
        "signal_names": list,
    }
    for key, kind in expected.items():
        if not isinstance(header.get(key), kind):
            raise RolloutError(
                f"header key {key!r} is {header.get(key)!r}; expected {getattr(kind, '__name__', 'a number')}"
            )
    return {key: header[key] for key in expected} | {
        "ground": header.get("ground"),
        "scan": header.get("scans", header.get("scan", [])),
    }


def _read_ground(figures: Any, numbers: Any) -> Terrain | None:
    """Return the ground that a header's figures and an entry describe; None if there is none."""
    if figures is None:
        return None
    try:
        if numbers.dtype != np.uint16:
            raise RolloutError(f"ground has numbers of type {numbers.dtype}; expected uint16")
        heights = Heights(numbers, float(figures["low"]), float(figures["step"])).metres()
        return Terrain(heights, figures["cell"], figures["origin"])
    except RolloutError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RolloutError(f"ground is damaged ({error}); expected heights with cell, origin, low and step") from None
