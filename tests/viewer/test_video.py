"""Videos: read back by other libraries, their pictures are those that the ray tracer draws at those times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hopper import StandIn, make_robot, make_rollout

from ce_gym import Terrain
from ce_gym.viewer import ViewerError, write_video

pytest.importorskip("embreex")
imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
Image = pytest.importorskip("PIL.Image")

SIZE = (96, 64)
SECONDS = 1.0


@pytest.fixture(scope="module")
def drawn() -> list[np.ndarray]:
    """What every frame of the rollout looks like."""
    from ce_gym.viewer.raytrace.picture import Picture

    rollout = make_rollout(51)
    picture = Picture(StandIn(make_robot()), rollout.q[0], width=SIZE[0], height=SIZE[1])
    return [picture.draw(q).astype(float) for q in rollout.q]


def nearest(image: np.ndarray, drawn: list[np.ndarray]) -> int:
    """Number of the frame that an image shows."""
    return int(np.argmin([np.abs(image - other).mean() for other in drawn]))


def test_a_gif_shows_the_frames_at_their_times(tmp_path: Path, drawn: list[np.ndarray]) -> None:
    file = write_video(make_rollout(51), tmp_path / "hop.gif", size=SIZE, model=StandIn(make_robot()))
    with Image.open(file) as film:
        assert film.size == SIZE
        assert film.n_frames == 21
        time = 0.0
        for index in range(film.n_frames):
            film.seek(index)
            image = np.asarray(film.convert("RGB"), float)
            assert nearest(image, drawn) * 0.02 == pytest.approx(time, abs=0.021)
            assert np.abs(image - drawn[round(time / 0.02)]).mean() < 6
            time += film.info["duration"] / 1000
    assert time == pytest.approx(SECONDS, abs=0.06)
    assert [path.name for path in tmp_path.iterdir()] == ["hop.gif"]


def test_an_mp4_shows_all_frames(tmp_path: Path, drawn: list[np.ndarray]) -> None:
    file = write_video(make_rollout(51), tmp_path / "hop.mp4", size=SIZE, fps=25, model=StandIn(make_robot()))
    frames = imageio_ffmpeg.read_frames(str(file))
    told = next(frames)
    images = [np.frombuffer(frame, np.uint8).reshape(SIZE[1], SIZE[0], 3).astype(float) for frame in frames]
    assert (told["size"], told["fps"], len(images)) == (SIZE, 25, 26)
    assert [nearest(image, drawn) for image in images] == pytest.approx(list(range(0, 51, 2)), abs=1)


def test_a_bad_size_is_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    with pytest.raises(ViewerError, match="size 95 x 64: expected even numbers from 16 to 4096"):
        write_video(make_rollout(), tmp_path / "hop.gif", size=(95, 64), model=StandIn(make_robot()))
    assert list(tmp_path.iterdir()) == []


def test_the_camera_finds_a_robot_that_begins_high_up(tmp_path: Path) -> None:
    """A film on a plateau equals the film on a plain."""

    def film(height: float) -> np.ndarray:
        rollout = make_rollout(3)
        plateau = Terrain.from_function(lambda x, y: height + 0 * x, 0.5, 40.0)
        raised = make_rollout(3, q=rollout.q + [0, 0, height, 0, 0, 0], ground=plateau)
        file = write_video(raised, tmp_path / f"{height}.gif", size=SIZE, model=StandIn(make_robot()))
        with Image.open(file) as pictures:
            return np.asarray(pictures.convert("RGB"), float)

    assert np.abs(film(2.0) - film(0.0)).mean() < 1
