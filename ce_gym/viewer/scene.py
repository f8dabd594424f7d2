"""Rollouts -> the commands of one meshcat scene: robots, arrows, stage and the animation that moves them.

Robots stand side by side, many of them in a square, or on top of each other as ghosts. The world moves under the camera
so that the first thing to leave the picture is the ground, not the robot. Knows rollouts and posed models; knows no
files, no servers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.viewer import arrows, three, tracks
from ce_gym.viewer.actor import Actor, PosedModel, smooth
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.robot import robot_commands
from ce_gym.viewer.rollout import Rollout
from ce_gym.viewer.stage import camera_commands, stage_commands
from ce_gym.viewer.three import Color, Command

Array = NDArray[np.float64]

ROOT = "/world"
GHOST_TINTS: tuple[Color, ...] = ((0.90, 0.45, 0.25), (0.25, 0.55, 0.85), (0.35, 0.65, 0.35))
GHOST_OPACITY = 0.4
ROW = 4  # so many stand in one row; more stand in a square
FOLLOW_SECONDS = 0.8  # the camera averages the robots' path over this time [s]


def make_actors(
    rollouts: Sequence[Rollout], models: Sequence[PosedModel] | None = None, max_fps: float = 50.0
) -> list[Actor]:
    """Pose the robots of rollouts.

    Args:
        rollouts: At least one.
        models: A posed model for each; built from the rollouts' robots if not given.
        max_fps: Frames beyond this rate are left out [1/s].

    Raises:
        ViewerError: There is nothing to show, or a rollout does not fit its robot.
    """
    if not rollouts:
        raise ViewerError("nothing to show: expected at least one rollout")
    if models is None:
        known = {(rollout.robot, rollout.transmission): rollout for rollout in rollouts}
        built = {key: load_model(rollout) for key, rollout in known.items()}
        models = [built[rollout.robot, rollout.transmission] for rollout in rollouts]
    pairs = zip(rollouts, models, strict=True)
    return [Actor(rollout, model, f"{ROOT}/{index}", max_fps) for index, (rollout, model) in enumerate(pairs)]


def build_scene(actors: Sequence[Actor], *, spacing: float | None = None) -> list[Command]:
    """Return the commands that show actors, the animation last.

    Args:
        actors: At least one.
        spacing: Distance between neighbours [m]; zero draws all but the first as ghosts in the same place. By default
            neighbours keep clear of each other. Robots that stand apart all start towards the same side, x.
    """
    poses = places(actors, 1.6 * max(actor.radius for actor in actors) if spacing is None else spacing)
    end = max(max(actor.times[-1], actor.rollout.dt) for actor in actors)
    commands = [*_stage(actors, poses)]
    clips = [_follow(actors, poses, end)]
    for index, actor in enumerate(actors):
        ghost = index > 0 and spacing == 0
        tint = GHOST_TINTS[(index - 1) % len(GHOST_TINTS)] if ghost else None
        commands += robot_commands(actor.robot, actor.path, tint=tint, opacity=GHOST_OPACITY if ghost else 1.0)
        commands.append(three.set_transform(actor.path, poses[index]))
        clips += actor.clips(end)
        for arrow in () if ghost else arrows.all_arrows(actor):
            commands += arrow.commands()
            clips.append(tracks.moving(arrow.path, actor.times, end, arrow.values()))
    return [*commands, tracks.set_animation(clips)]


def load_model(rollout: Rollout) -> PosedModel:
    """Return the model that a rollout was made with."""
    from ce_gym.dynamics import Model

    return Model(rollout.robot, transmission=rollout.transmission)


def places(actors: Sequence[Actor], spacing: float) -> list[Array]:
    """Return where the world of each actor is put, shape (4, 4); ghosts share that of the first."""
    count = len(actors)
    if spacing == 0:
        return [np.linalg.inv(actors[0].start).astype(np.float64)] * count
    columns = count if count <= ROW else int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    result = []
    for index, actor in enumerate(actors):
        row, column = divmod(index, columns)
        place = [spacing * ((rows - 1) / 2 - row), spacing * ((columns - 1) / 2 - column), 0.0]
        result.append(three.transform(place) @ np.linalg.inv(actor.start))
    return result


def _stage(actors: Sequence[Actor], poses: Sequence[Array]) -> Iterator[Command]:
    paths = [_moved(actor.positions[..., :2].reshape(-1, 2), pose) for actor, pose in zip(actors, poses, strict=True)]
    starts = np.array([_moved(actor.middle[:1], pose)[0] for actor, pose in zip(actors, poses, strict=True)])
    radius = max(actor.radius for actor in actors) + float(np.linalg.norm(np.ptp(starts, 0))) / 2
    corners = np.concatenate(paths)
    yield from stage_commands(corners.min(0), corners.max(0), root=ROOT, radius=radius)
    yield three.set_transform(ROOT, three.transform([0.0, 0.0, -_height(actors)]))
    yield from camera_commands(radius)


def _height(actors: Sequence[Actor]) -> float:
    """Return the height of the middle of the robots [m], which the camera looks at."""
    return float(min(actor.low[2] for actor in actors) + max(actor.high[2] for actor in actors)) / 2


def _moved(points: Array, pose: Array) -> Array:
    """Return points of the ground, shape (n, 2), moved by a pose, shape (4, 4)."""
    return points @ pose[:2, :2].T + pose[:2, 3]


def _follow(actors: Sequence[Actor], poses: Sequence[Array], end: float) -> Command:
    """Move the world against the mean path of the robots' middles, so that they stay before the camera."""
    times = max((actor.times for actor in actors), key=len)
    middles = [_moved(actor.middle, pose) for actor, pose in zip(actors, poses, strict=True)]
    pairs = zip(actors, middles, strict=True)
    paths = [[np.interp(times, actor.times, middle[:, axis]) for axis in (0, 1)] for actor, middle in pairs]
    centre = smooth(np.mean(paths, 0).T, times, FOLLOW_SECONDS)
    return tracks.moving(
        ROOT, times, end, {"position": np.column_stack([-centre, np.full(len(times), -_height(actors))])}
    )
