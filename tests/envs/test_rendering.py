"""Pictures and live pages of environments: what they show, that videos are written, that nothing is left behind."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import urllib.parse
import urllib.request
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import RecordVideo as RecordVideos

import ce_gym
from ce_gym.envs.task.terrain_tiles import checked_terrain, make_field
from ce_gym.viewer import ViewerError

ENV = "ce_gym/MiniCheetahVelocity-v0"
ROBOT = "mini_cheetah"
SMALL = {"width": 80, "height": 60}


def make(mode: str | None = "rgb_array", **arguments):
    return gymnasium.make(ENV, render_mode=mode, **arguments).unwrapped


@pytest.fixture
def env():
    pytest.importorskip("embreex")
    env = make(**SMALL)
    env.reset(seed=0)
    yield env
    env.close()


def with_q(env, index: int, value: float) -> np.ndarray:
    """Draw with one coordinate replaced."""
    q = env.batch.rows("q")
    q[0, index] = value
    env.batch.write("q", q)
    return env.render()


def test_a_picture_is_an_array_of_the_size_asked_for(env):
    picture = env.render()
    assert picture.shape == (60, 80, 3)
    assert picture.dtype == np.uint8
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    default = make()
    default.reset(seed=0)
    assert default.render().shape == (480, 640, 3)


def test_the_robot_is_in_the_middle_and_the_stage_around_it(env):
    picture = env.render().astype(int)
    empty = with_q(env, 2, 500.0).astype(int)  # far above the picture, shadow included: it falls beside the stage
    differs = np.abs(picture - empty).max(-1) > 40
    rows, columns = np.nonzero(differs)
    assert 0.03 < differs.mean() < 0.5
    assert abs(columns.mean() - 40) < 12
    assert abs(rows.mean() - 30) < 12
    assert not differs[:, :8].any()
    assert not differs[:, -8:].any()
    assert empty[0].mean(0)[2] > empty[0].mean(0)[0]  # the sky is blue
    assert len(np.unique(empty[40:].reshape(-1, 3), axis=0)) > 10  # the floor has a pattern


def test_a_state_gives_one_picture_and_another_state_another(env):
    first = env.render()
    np.testing.assert_array_equal(env.render(), first)
    env.step(np.ones(12, np.float32))
    for _ in range(5):
        env.step(np.ones(12, np.float32))
    assert (env.render() != first).any()


def test_the_camera_follows_and_the_floor_passes_by(env):
    here = with_q(env, 0, 0.0)
    np.testing.assert_array_equal(with_q(env, 0, 40.0), here)  # whole tiles further everything looks the same
    there = with_q(env, 0, 0.5)  # one square: light and dark change places, the robot stays
    robot = np.s_[24:27, 38:42]
    np.testing.assert_array_equal(there[robot], here[robot])
    assert (there != here).any(-1).mean() > 0.2


def test_a_robot_below_the_ground_is_hidden_by_it(env):
    below = with_q(env, 2, -0.5)
    np.testing.assert_array_equal(below, with_q(env, 2, -0.8))


ROUGH = {"kind": "rough", "amplitude": 0.08, "levels": 2, "columns": 2, "size": 4.0, "curriculum": False}


@pytest.fixture(scope="module")
def field_of_stairs():
    """A pit of stairs, its middle at (2, 2), and a pyramid, its middle at (2, 6)."""
    return make_field(checked_terrain({"kind": "stairs", "levels": 2, "columns": 2, "size": 4.0, "rise": 0.2}))


def standing_on(terrain, model, x: float, y: float) -> np.ndarray:
    q = model.standing_q.copy()
    q[:3] += [x, y, terrain.at(x, y)[0]]
    return q


def test_ground_that_is_not_flat_is_seen(field_of_stairs):
    """Steps change the picture around the robot; the robot itself stays where flat ground has it."""
    pytest.importorskip("embreex")
    from ce_gym.viewer.raytrace.picture import Picture

    model = ce_gym.Model(ROBOT)
    stairs = Picture(model, model.standing_q, terrain=field_of_stairs, **SMALL)
    level = Picture(model, model.standing_q, terrain=ce_gym.Terrain.flat(), **SMALL)
    flat = Picture(model, model.standing_q, **SMALL)
    q = standing_on(ce_gym.Terrain.flat(), model, 2.0, 2.0)
    one, other = level.draw(q).astype(int), flat.draw(q).astype(int)
    near = np.s_[24:]  # below the horizon: farther away the one ends and the other does not
    assert np.abs(one - other)[near].max(-1).mean() < 4
    high = stairs.draw(standing_on(field_of_stairs, model, 7.3, 2.0)).astype(int)
    assert (np.abs(high - one)[near].max(-1) > 12).mean() > 0.1
    dark = [np.argwhere(picture[10:50].mean(-1) < 80).mean(0) for picture in (high, one)]  # the torso and the legs
    np.testing.assert_allclose(*dark, atol=3)


def test_a_picture_on_a_field_depends_on_the_pose_alone(field_of_stairs):
    pytest.importorskip("embreex")
    from ce_gym.viewer.raytrace.picture import Picture

    model = ce_gym.Model(ROBOT)
    stairs = Picture(model, model.standing_q, terrain=field_of_stairs, **SMALL)
    q = standing_on(field_of_stairs, model, 6.3, 2.1)
    first = stairs.draw(q)
    stairs.draw(standing_on(field_of_stairs, model, 3.0, 5.0))
    np.testing.assert_array_equal(stairs.draw(q), first)


def test_a_robot_in_a_pit_is_not_hidden_by_its_rim():
    """It is seen as large as on flat ground, to a fifth; the camera goes up for that."""
    pytest.importorskip("embreex")
    from ce_gym.viewer.raytrace.picture import Picture

    model = ce_gym.Model(ROBOT)
    pit = ce_gym.Terrain.from_function(lambda x, y: np.clip(0.6 * (np.hypot(x, y) - 0.4), 0, 1), 0.1, 12.0)

    def size(terrain) -> float:
        picture = Picture(model, model.standing_q, terrain=terrain, **SMALL)
        q = standing_on(terrain, model, 0.0, 0.0)
        gone = q + 500.0 * (np.arange(model.nq) == 2)
        return (np.abs(picture.draw(q).astype(int) - picture.draw(gone)).max(-1) > 40).mean()

    assert size(pit) > 0.8 * size(ce_gym.Terrain.flat())


@pytest.mark.slow
def test_environments_show_their_ground(capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("embreex")
    pytest.importorskip("meshcat")
    rough = make(terrain=ROUGH, **SMALL)
    rough.reset(seed=1)
    pictures = [rough.render()]
    rough.batch.write("q", rough.batch.rows("q") + 0.5 * (np.arange(rough.model.nq) == 0))
    pictures.append(rough.render())
    assert (pictures[0] != pictures[1]).any(-1).mean() > 0.2
    env = make("human", terrain=ROUGH)
    env.reset(seed=1)
    url = capsys.readouterr().out.split()[-1]
    with urllib.request.urlopen(url + "events", timeout=5) as events:
        assert events.readline() == b"event: ground\n"
        command = json.loads(events.readline()[len("data: ") :])
        assert command["object"]["object"]["userData"]["field"]["reach"] > 1.0
        events.readline()
        moves = json.loads(events.readline()[len("data: ") :])["moves"]
        x, y = env.batch.rows("q")[0, :2]
        np.testing.assert_allclose(moves["/world"][12:14], [-x, -y], atol=1e-6)
        env.close()


@pytest.mark.parametrize("robot", ["mit_humanoid", "jvrc1", "four_bar"])
def test_every_kind_of_robot_can_be_seen(robot: str):
    pytest.importorskip("embreex")
    from ce_gym.viewer.raytrace.picture import Picture

    model = ce_gym.Model(robot)
    picture = Picture(model, model.standing_q, **SMALL)
    here = picture.draw(model.standing_q).astype(int)
    moved = np.arange(model.nq) == (2 if model.robot.floating else 0)
    elsewhere = picture.draw(model.standing_q + (500.0 if model.robot.floating else 0.5) * moved)
    assert (np.abs(here - elsewhere).max(-1) > 40).mean() > 0.005


def test_a_vector_gives_a_picture_of_each():
    pytest.importorskip("embreex")
    envs = gymnasium.make_vec(ENV, num_envs=3, render_mode="rgb_array", **SMALL)
    envs.reset(seed=5)
    pictures = envs.render()
    assert isinstance(pictures, tuple)
    assert [picture.shape for picture in pictures] == [(60, 80, 3)] * 3
    assert (pictures[0] != pictures[1]).any()
    single = make(**SMALL)
    single.reset(seed=6)
    np.testing.assert_array_equal(pictures[1], single.render())
    envs.close()


def test_videos_are_written(tmp_path: Path):
    pytest.importorskip("embreex")
    pytest.importorskip("moviepy")
    env = RecordVideo(gymnasium.make(ENV, render_mode="rgb_array", **SMALL), str(tmp_path / "one"))
    envs = RecordVideos(
        gymnasium.make_vec(ENV, num_envs=4, render_mode="rgb_array", **SMALL), str(tmp_path / "four"), video_length=5
    )
    for recorded in (env, envs):
        recorded.reset(seed=0)
        for _ in range(8):
            recorded.step(recorded.action_space.sample())
        recorded.close()
    for folder, size in (("one", (80, 60)), ("four", (160, 120))):
        (film,) = (tmp_path / folder).glob("*.mp4")
        assert film_size(film) == size


def film_size(path: Path) -> tuple[int, int]:
    from moviepy import VideoFileClip

    with VideoFileClip(str(path)) as clip:
        assert clip.duration > 0
        return tuple(clip.size)


@pytest.mark.parametrize("mode", ["human", "rgb_array"])
def test_check_env_is_silent_in_every_mode(mode: str, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("embreex")
    pytest.importorskip("meshcat")
    monkeypatch.delenv("DISPLAY", raising=False)
    env = gymnasium.make(ENV, render_mode=mode, **SMALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()
    env.close()


def test_a_page_gets_every_pose_and_closing_frees_the_port(capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("meshcat")
    env = make("human")
    env.reset(seed=0)
    assert env.render() is None
    env.step(np.zeros(12, np.float32))
    (line,) = capsys.readouterr().out.splitlines()  # said once
    url = line.split()[-1]
    assert url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(url, timeout=5) as page:
        assert b"EventSource" in page.read()
    with urllib.request.urlopen(url + "events", timeout=5) as events:
        first = json.loads(events.readline()[len("data: ") :])["moves"]
        events.readline()
        for _ in range(20):
            env.step(np.ones(12, np.float32))
        moves = json.loads(events.readline()[len("data: ") :])["moves"]
        assert moves.keys() == first.keys()
        assert moves != first
        x, y = env.batch.rows("q")[0, :2]
        newest = moves
        while (line := events.readline()) and not np.allclose(newest["/world"][12:14], [-x, -y], atol=1e-6):
            if line.startswith(b"data: "):
                newest = json.loads(line[len("data: ") :])["moves"]
        assert np.allclose(newest["/world"][12:14], [-x, -y], atol=1e-6)
        env.close()
        assert b"data" not in events.read()  # the stream ends
    env.close()
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # past connections may linger; a listener may not
        free.bind(("127.0.0.1", urllib.parse.urlsplit(url).port))


def test_nothing_to_render_without_a_mode():
    env = make(None)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "ansi"}, "render_mode='ansi'; expected one of human, rgb_array, or None"),
        ({"render_mode": "rgb_array", "width": 0}, "width=0; expected a whole number of pixels"),
        ({"render_mode": "rgb_array", "height": 4.5}, "height=4.5; expected a whole number of pixels"),
    ],
)
def test_bad_arguments(arguments: dict, message: str):
    from ce_gym.envs.single import LeggedEnv
    from ce_gym.envs.vector import LeggedVectorEnv

    for kind in (LeggedEnv, LeggedVectorEnv):
        with pytest.raises(ValueError, match=message):
            kind(**arguments)


@pytest.mark.parametrize(("mode", "library"), [("rgb_array", "embreex"), ("human", "meshcat")])
def test_a_missing_library_is_one_line_when_the_environment_is_made(mode, library, monkeypatch):
    for name in [library, *(name for name in sys.modules if name.startswith(f"{library}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    extra = {"embreex": "video", "meshcat": "viewer"}[library]
    message = rf'{library}, which is not installed: pip install "ce_gym\[{extra}\]"'
    with pytest.raises(ViewerError, match=message) as error:
        make(mode)
    assert "\n" not in str(error.value)


def test_import_brings_no_renderer():
    heavy = ("embreex", "meshcat", "ce_gym.viewer.raytrace.picture")
    code = f"import ce_gym, sys; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_an_environment_with_a_screen_survives_pickling():
    pytest.importorskip("embreex")
    import pickle

    env = make(**SMALL)
    env.reset(seed=3)
    again = pickle.loads(pickle.dumps(env))
    again.reset(seed=3)
    np.testing.assert_array_equal(again.render(), env.render())
