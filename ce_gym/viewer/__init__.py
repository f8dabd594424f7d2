"""Recorded rollouts, shown as one HTML file, as a page served on the loopback interface, or as a video.

    env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0", contact_forces=True)
    rollout = record(env, lambda observation: env.action_space.sample(), seconds=5.0)
    rollout.save("walk.npz")
    write_html(Rollout.load("walk.npz"), "walk.html")
    write_video(Rollout.load("walk.npz"), "walk.gif")

meshcat is needed only for pages, embreex and imageio-ffmpeg only for videos.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ce_gym.viewer.errors import ViewerError
    from ce_gym.viewer.page.html import write_html
    from ce_gym.viewer.rollouts.driving import SHOW, Script, drive, drive_many, walk
    from ce_gym.viewer.rollouts.recorder import Recorder
    from ce_gym.viewer.rollouts.recording import record, record_lanes
    from ce_gym.viewer.rollouts.rollout import Rollout, RolloutError
    from ce_gym.viewer.server import show
    from ce_gym.viewer.video import write_video

__all__ = [
    "SHOW",
    "Recorder",
    "Rollout",
    "RolloutError",
    "Script",
    "ViewerError",
    "drive",
    "drive_many",
    "record",
    "record_lanes",
    "show",
    "walk",
    "write_html",
    "write_video",
]

_HOMES = {
    "SHOW": "rollouts.driving",
    "Script": "rollouts.driving",
    "drive": "rollouts.driving",
    "drive_many": "rollouts.driving",
    "walk": "rollouts.driving",
    "record": "rollouts.recording",
    "record_lanes": "rollouts.recording",
    "Recorder": "rollouts.recorder",
    "Rollout": "rollouts.rollout",
    "RolloutError": "rollouts.rollout",
    "ViewerError": "errors",
    "show": "server",
    "write_html": "page.html",
    "write_video": "video",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: the command line parses its arguments without numpy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
