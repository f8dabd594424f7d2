"""Shows recorded rollouts as one HTML file, as a page served on the loopback interface, or as a video.

    env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0", contact_forces=True)
    rollout = record(env, lambda observation: env.action_space.sample(), seconds=5.0)
    rollout.save("walk.npz")
    write_html(Rollout.load("walk.npz"), "walk.html")
    write_video(Rollout.load("walk.npz"), "walk.gif")

Pages need meshcat; videos need embreex and imageio-ffmpeg.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ce_gym.viewer.errors import ViewerError
    from ce_gym.viewer.page.html import show, write_html
    from ce_gym.viewer.rollouts.driving import SHOW, Script, drive, drive_many, walk
    from ce_gym.viewer.rollouts.recording import Recorder, record, record_lanes
    from ce_gym.viewer.rollouts.rollout import Rollout, RolloutError
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
    "Recorder": "rollouts.recording",
    "Rollout": "rollouts.rollout",
    "RolloutError": "rollouts.rollout",
    "ViewerError": "errors",
    "show": "page.html",
    "write_html": "page.html",
    "write_video": "video",
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use: the command line parses its arguments without numpy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
