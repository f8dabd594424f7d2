"""Videos of rollouts: ray-traced MP4, WebM or GIF files, without a display or a browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.console import progress
from ce_gym.files import VIDEOS, check_output, written
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page.scene import load_model
from ce_gym.viewer.raytrace.picture import Picture
from ce_gym.viewer.rollouts.rollout import Rollout

# For a GIF, ffmpeg chooses one palette for the whole film, and stores differences between frames.
_PALETTE = "split[a][b];[a]palettegen=max_colors=128[p];[b][p]paletteuse=dither=bayer:bayer_scale=5:diff_mode=rectangle"
KINDS: dict[str, tuple[float, dict[str, Any]]] = {
    ".mp4": (50.0, {"codec": "libx264", "output_params": ["-crf", "23", "-movflags", "+faststart"]}),
    ".webm": (50.0, {"codec": "libvpx-vp9", "output_params": ["-crf", "36", "-b:v", "0"]}),
    ".gif": (20.0, {"codec": "gif", "pix_fmt_out": "pal8", "output_params": ["-vf", _PALETTE]}),
}
"""Largest frame rate [1/s] and ffmpeg options, by the ending of the file."""
SMALLEST, LARGEST = 16, 4096  # edge of a picture [pixels]


def write_video(
    rollout: Rollout,
    path: str | Path,
    *,
    size: tuple[int, int] = (640, 480),
    fps: float | None = None,
    model: Any = None,
) -> Path:
    """Write a rollout as a video in real time and return its path.

    Args:
        rollout: The rollout.
        path: A name that ends in .mp4, .webm or .gif.
        size: Width and height [pixels], even numbers.
        fps: Frame rate, at most the rollout's rate [1/s]; by default up to 50, for a GIF up to 20.
        model: The `Model` of the robot; built from the rollout if not given.

    Raises:
        ViewerError: The name or the size is invalid, embreex or imageio-ffmpeg is not installed, or the file cannot be
            written.
    """
    path = Path(path)
    check_video(path, size)
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ViewerError.missing("imageio-ffmpeg") from None
    default_fps, encoding = KINDS[path.suffix.lower()]
    fps = min(fps or default_fps, 1 / rollout.dt)
    model = model or load_model(rollout)
    width, height = size
    picture = Picture(model, _as_on_a_plane(rollout, model), width=width, height=height, terrain=rollout.ground)
    write_frames: Any = imageio_ffmpeg.write_frames
    options = {"fps": fps, "macro_block_size": 2, "ffmpeg_log_level": "error", **encoding}
    with written(path, VIDEOS[path.suffix.lower()]) as temporary:
        try:
            with contextlib.closing(write_frames(str(temporary), size, **options)) as film:
                film.send(None)
                for pixels in _pictures(rollout, picture, fps):
                    film.send(pixels)
        except OSError as error:
            raise ViewerError(f"{path}: ffmpeg cannot write it ({' '.join(str(error).split())[:200]})") from None
    return path


def check_video(path: Path, size: tuple[int, int]) -> None:
    """Check the name and the size of a video, before a simulation.

    Raises:
        ViewerError: The name or the size is invalid.
    """
    if path.suffix.lower() not in KINDS:
        raise ViewerError(f"{path}: expected a name that ends in {', '.join(KINDS)}")
    if not path.resolve().parent.is_dir():
        raise ViewerError(f"{path}: no such folder; expected an existing one")
    check_output(path, VIDEOS[path.suffix.lower()])
    for edge in size:
        if edge % 2 or not SMALLEST <= edge <= LARGEST:
            raise ViewerError(
                f"size {size[0]} x {size[1]}: expected even numbers from {SMALLEST} to {LARGEST} [pixels]"
            )


def _as_on_a_plane(rollout: Rollout, model: Any) -> NDArray[np.float64]:
    """Return the first positions of a rollout, moved onto the plane z = 0, shape (nq,)."""
    q = rollout.q[0].copy()
    if rollout.ground is not None and model.robot.floating:
        q[2] -= rollout.ground.at(*q[:2])[0]
    return q


def _pictures(rollout: Rollout, picture: Picture, fps: float) -> Iterator[NDArray[np.uint8]]:
    """Draw the frame nearest to each time of the film."""
    moments = rollout.times[0] + np.arange(int(rollout.duration * fps) + 1) / fps
    nearest = np.abs(rollout.times - moments[:, None]).argmin(1)
    for frame in progress(nearest.tolist(), "drawing"):
        yield picture.draw(rollout.q[frame])
