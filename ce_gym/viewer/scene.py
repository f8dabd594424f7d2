"""Rollouts -> the commands of one meshcat scene: robots, arrows, stage and the animation that moves them.

Robots stand side by side, or on top of each other as ghosts, and the world moves under the camera so that the first
thing to leave the picture is the ground, not the robot. Knows rollouts and posed models; knows no files, no servers.
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
FOLLOW_SECONDS = 0.8  # the camera averages the robots' path over this time [s]


def build_scene(
    rollouts: Sequence[Rollout],
    models: Sequence[PosedModel] | None = None,
    *,
    spacing: float | None = None,
    max_fps: float = 50.0,
) -> list[Command]:
    """Return the commands that show rollouts, the animation last.

    Args:
        rollouts: At least one.
        models: A posed model for each; built from the rollouts' robots if not given.
        spacing: Distance between neighbours [m]; zero draws all but the first as ghosts in the same place. By default
            neighbours keep clear of each other.
        max_fps: Frames beyond this rate are left out [1/s].

    Raises:
        ViewerError: There is nothing to show, or a rollout does not fit its robot.
    """
    if not rollouts:
        raise ViewerError("nothing to show: expected at least one rollout")
    models = [load_model(rollout) for rollout in rollouts] if models is None else models
    pairs = zip(rollouts, models, strict=True)
    actors = [Actor(rollout, model, f"{ROOT}/{index}", max_fps) for index, (rollout, model) in enumerate(pairs)]
    spacing = 1.6 * max(actor.radius for actor in actors) if spacing is None else spacing
    end = max(max(actor.times[-1], actor.rollout.dt) for actor in actors)
    commands = [*_stage(actors, spacing)]
    clips = [_follow(actors, end)]
    for index, actor in enumerate(actors):
        ghost = index > 0 and spacing == 0
        commands += _actor(actor, index, ghost=ghost, lateral=_lateral(index, actors, spacing))
        clips += actor.clips(end)
        for arrow in () if ghost else arrows.all_arrows(actor):
            commands += arrow.commands()
            clips.append(tracks.moving(arrow.path, actor.times, end, arrow.values()))
    return [*commands, tracks.set_animation(clips)]


def load_model(rollout: Rollout) -> PosedModel:
    """Return the model that a rollout was made with."""
    from ce_gym.dynamics import Model

    return Model(rollout.robot, transmission=rollout.transmission)


def _lateral(index: int, actors: list[Actor], spacing: float) -> float:
    return spacing * ((len(actors) - 1) / 2 - index)


def _actor(actor: Actor, index: int, *, ghost: bool, lateral: float) -> Iterator[Command]:
    tint = GHOST_TINTS[(index - 1) % len(GHOST_TINTS)] if ghost else None
    yield from robot_commands(actor.robot, actor.path, tint=tint, opacity=GHOST_OPACITY if ghost else 1.0)
    yield three.set_transform(actor.path, three.transform([0.0, lateral, 0.0]))


def _stage(actors: list[Actor], spacing: float) -> Iterator[Command]:
    width = spacing * (len(actors) - 1)
    radius = max(actor.radius for actor in actors) + width / 2
    corners = np.concatenate([actor.positions[..., :2].reshape(-1, 2) for actor in actors])
    margin = np.array([0.0, width / 2])
    yield from stage_commands(corners.min(0) - margin, corners.max(0) + margin, root=ROOT, radius=radius)
    middle = (min(actor.low[2] for actor in actors) + max(actor.high[2] for actor in actors)) / 2
    yield from camera_commands(np.array([0.0, 0.0, middle]), radius)


def _follow(actors: list[Actor], end: float) -> Command:
    """Move the world against the mean path of the robots' middles, so that they stay before the camera."""
    times = max((actor.times for actor in actors), key=len)
    paths = [[np.interp(times, actor.times, actor.middle[:, axis]) for axis in (0, 1)] for actor in actors]
    centre = smooth(np.mean(paths, 0).T, times, FOLLOW_SECONDS)
    return tracks.moving(ROOT, times, end, {"position": np.column_stack([-centre, np.zeros(len(times))])})
