"""The commands of one meshcat scene for some rollouts: robots, arrows, surroundings and the animation.

Robots stand side by side, many in a square; ghosts stand in the place of the first robot. The camera is fixed, and the
world moves under it, so that robots stay in view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.meshes.triangles import MOST
from ce_gym.viewer.page import arrows, three
from ce_gym.viewer.page.lights_and_camera import camera_commands, eye, field_command, surroundings
from ce_gym.viewer.page.overlays import overlay_commands
from ce_gym.viewer.page.poses import PosedRollout, smooth
from ce_gym.viewer.page.robot import body_paths, placed_scans, robot_commands
from ce_gym.viewer.page.three import Color, Command
from ce_gym.viewer.rollouts.ground_patch import around, clear_view, reach
from ce_gym.viewer.rollouts.rollout import Rollout

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]

ROOT = "/world"
GHOST_TINTS: tuple[Color, ...] = ((0.90, 0.45, 0.25), (0.25, 0.55, 0.85), (0.35, 0.65, 0.35))
GHOST_OPACITY = 0.4
ROW = 4  # most robots in one row; more robots stand in a square
APART = 3.0  # distance between robots on separate ground, in radii
FOLLOW_SECONDS = 0.8  # the camera follows the robots' mean path over this time [s]


def pose_rollouts(
    rollouts: Sequence[Rollout], models: Sequence[Model] | None = None, max_fps: float = 50.0
) -> list[PosedRollout]:
    """Return rollouts with the poses of their bodies.

    Args:
        rollouts: At least one.
        models: The `Model` of each rollout; built from the rollouts if not given.
        max_fps: Frames beyond this rate are left out [1/s].

    Raises:
        ViewerError: There is no rollout, or a rollout does not fit its robot.
    """
    if not rollouts:
        raise ViewerError("nothing to show: expected at least one rollout")
    if models is None:
        distinct = {(rollout.robot, rollout.transmission): rollout for rollout in rollouts}
        built = {key: load_model(rollout) for key, rollout in distinct.items()}
        models = [built[rollout.robot, rollout.transmission] for rollout in rollouts]
    pairs = zip(rollouts, models, strict=True)
    return [PosedRollout(rollout, model, f"{ROOT}/{index}", max_fps) for index, (rollout, model) in enumerate(pairs)]


def build_scene(runs: Sequence[PosedRollout], *, spacing: float | None = None) -> list[Command]:
    """Return the commands that show posed rollouts, the animation last.

    Args:
        runs: At least one.
        spacing: Distance between neighbours [m]; 0 draws all but the first as ghosts in the same place. By default
            neighbours do not overlap. All robots start in the direction of x.
    """
    if spacing is None:
        spacing = (1.6 if _all_flat(runs) else APART) * max(run.extent.radius for run in runs)
    poses = places(runs, spacing)
    end = max(max(run.times[-1], run.rollout.dt) for run in runs)
    commands = [*_surroundings(runs, poses), *_fields(runs, poses, spacing)]
    clips = [_follow(runs, poses, end)]
    for index, run in enumerate(runs):
        ghost = index > 0 and spacing == 0
        tint = GHOST_TINTS[(index - 1) % len(GHOST_TINTS)] if ghost else None
        opacity = GHOST_OPACITY if ghost else 1.0
        commands += robot_commands(run.robot, run.path, tint=tint, opacity=opacity, triangles=MOST // len(runs))
        commands.append(three.set_transform(run.path, poses[index]))
        clips += run.clips(end)
        commands += () if ghost else overlay_commands(run.robot, run.path)
        for arrow in () if ghost else arrows.all_arrows(run):
            commands += arrow.commands()
            clips.append(three.clip(arrow.path, run.times, end, arrow.values()))
    return [*commands, three.set_animation(clips)]


def load_model(rollout: Rollout) -> Model:
    """Return the model of a rollout's robot at its transmission level."""
    from ce_gym.dynamics import Model

    return Model(rollout.robot, transmission=rollout.transmission)


def places(runs: Sequence[PosedRollout], spacing: float) -> list[Array]:
    """Return the pose of each rollout's world in the scene, shape (4, 4); ghosts have the pose of the first."""
    count = len(runs)
    if spacing == 0:
        return [np.linalg.inv(runs[0].start).astype(np.float64)] * count
    columns = count if count <= ROW else int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    poses = []
    for index, run in enumerate(runs):
        row, column = divmod(index, columns)
        place = [spacing * ((rows - 1) / 2 - row), spacing * ((columns - 1) / 2 - column), 0.0]
        poses.append(three.transform(place) @ np.linalg.inv(run.start))
    return poses


def _surroundings(runs: Sequence[PosedRollout], poses: Sequence[Array]) -> Iterator[Command]:
    """Draw flat ground, sky and lights, and place the camera."""
    paths = [_moved(run.positions[..., :2].reshape(-1, 2), pose) for run, pose in zip(runs, poses, strict=True)]
    starts = np.array([_moved(run.middle[:1], pose)[0] for run, pose in zip(runs, poses, strict=True)])
    radius = max(run.extent.radius for run in runs) + float(np.linalg.norm(np.ptp(starts, 0))) / 2
    corners = np.concatenate(paths)
    yield from surroundings(corners.min(0), corners.max(0), root=ROOT, radius=radius, flat=_all_flat(runs))
    height = _height(runs)
    yield three.set_transform(ROOT, three.transform([0.0, 0.0, -height]))
    place = eye(radius)
    if len(runs) == 1 or np.ptp(starts, 0).max() == 0:
        place[2] = _camera_height(runs[0], height, radius, place)
    yield from camera_commands(place)


def _camera_height(run: PosedRollout, height: float, radius: float, place: Array) -> float:
    """Return the height of the camera above its target for which the ground never hides the robot [m]."""
    ground, frames, turn = run.rollout.ground, slice(None, None, 10), run.start[:3, :3]
    targets = np.column_stack([run.middle, run.levels + height])[frames]
    return max(float(clear_view(ground, at, at + turn @ place, radius / 4)[2] - at[2]) for at in targets)


def _all_flat(runs: Sequence[PosedRollout]) -> bool:
    return all(run.rollout.ground is None for run in runs)


def _fields(runs: Sequence[PosedRollout], poses: Sequence[Array], spacing: float) -> Iterator[Command]:
    """Draw uneven ground: one piece for ghosts, otherwise a disc that moves with each robot."""
    if _all_flat(runs):
        return
    bases = [body_paths(run.robot, run.path)[run.robot.bodies[0].name] for run in runs]
    grounds = [run.rollout.ground or around(Terrain.flat(), run.middle) for run in runs]
    if len(runs) > 1 and spacing > 0:
        for index, run in enumerate(runs):
            far = min(spacing / 2, reach(grounds[index], run.middle))
            piece = around(grounds[index], run.middle, far)
            scans = placed_scans(run.rollout.scan, run.robot, run.path)
            yield field_command(f"{ROOT}/ground_{index}", piece, [bases[index]], far, 0.8, scans)
            yield three.set_transform(f"{ROOT}/ground_{index}", poses[index])
        return
    path = np.concatenate([run.middle for run in runs])
    widest = max(grounds, key=lambda ground: reach(ground, path))
    scans = placed_scans(runs[0].rollout.scan, runs[0].robot, runs[0].path)
    yield field_command(f"{ROOT}/ground", widest, bases, reach(widest, runs[0].middle), scans=scans)
    yield three.set_transform(f"{ROOT}/ground", poses[0])


def _height(runs: Sequence[PosedRollout]) -> float:
    """Return the height of the robots' middle above the ground at the start [m], the camera's target."""
    low = min(run.extent.low[2] - run.levels[0] for run in runs)
    return float(low + max(run.extent.high[2] - run.levels[0] for run in runs)) / 2


def _moved(points: Array, pose: Array) -> Array:
    """Return points of the ground, shape (n, 2), moved by a pose, shape (4, 4)."""
    return points @ pose[:2, :2].T + pose[:2, 3]


def _follow(runs: Sequence[PosedRollout], poses: Sequence[Array], end: float) -> Command:
    """Move the world against the mean path of the robots, which keeps them before the camera."""
    times = max((run.times for run in runs), key=len)
    paths = []
    for run, pose in zip(runs, poses, strict=True):
        columns = (*_moved(run.middle, pose).T, run.levels + pose[2, 3])
        paths.append([np.interp(times, run.times, column) for column in columns])
    centre = smooth(np.mean(paths, 0).T, times, FOLLOW_SECONDS)
    return three.clip(ROOT, times, end, {"position": -centre - [0.0, 0.0, _height(runs)]})
