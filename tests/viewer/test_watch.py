"""The page of a training run: reading logs, messages to the page, and the end of its process."""

from __future__ import annotations

import http.client
import json
import os
import socket
import subprocess
import sys
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from chromium import PROGRAM, Chromium

from ce_gym.policies import Actor, write_npz
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.stream import serving
from ce_gym.viewer.watch.run_log import LENGTH, REWARD, SPEED, find_runs, read_log
from ce_gym.viewer.watch.walker import newest_policy
from ce_gym.viewer.watch.watcher import Watcher, first_plots

pytest.importorskip("meshcat")

ROOT = Path(__file__).parents[2]
TRIPOD = str(ROOT / "tests" / "data" / "tripod" / "tripod.yaml")
ENV = "ce_gym/MiniCheetahVelocity-v0"
KWARGS = {"robot": TRIPOD, "contact_forces": False}
HEADER = "time/total_timesteps,time/time_elapsed,rollout/ep_rew_mean,rollout/ep_len_mean"
HEADER += ",reward/pose,reward/torques,train/std"


def log(rows: int, first: int = 1) -> str:
    lines = [f"{100 * i},{2 * i},{0.5 * i},{10 + i},{-i},{-0.1 * i}," for i in range(first, first + rows)]
    return "\n".join([HEADER, *lines]) + "\n"


def policy(file: Path, bias: float = 0.1, steps: int = 300, **changes: Any) -> Path:
    """The same action whatever is seen."""
    env = gymnasium.make_vec(ENV, 1, vectorization_mode="vector_entry_point", **KWARGS)
    size, actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]  # type: ignore[index]
    env.close()
    layers = ((np.zeros((actions, size), np.float32), np.full(actions, bias, np.float32)),)
    record = {"env": ENV, "env_kwargs": KWARGS, "transmission": "exact", "observation_size": size}
    record |= {"action_size": actions, "activation": "Tanh", "policy_spec": {}, "steps": steps, "finished": True}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_npz(Actor(layers, "Tanh"), {**record, "settings": {"steps": 600}, **changes}, file)
    return file


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "progress.csv").write_text(log(3))
    return folder


def test_figures_are_those_of_the_files(run: Path):
    found = read_log(run)
    assert (found.name, found.seconds, found.steps.tolist()) == ("run", 6.0, [100, 200, 300])
    assert found.signals[REWARD].tolist() == [0.5, 1.0, 1.5]
    assert found.signals[LENGTH].tolist() == [11, 12, 13]
    assert found.signals["reward: pose"].tolist() == [-1, -2, -3]
    assert found.signals[SPEED].tolist() == [50, 50, 50]
    assert np.isnan(found.signals["learning: std"]).all()
    assert first_plots([found]) == [[REWARD], [LENGTH], ["reward: pose", "reward: torques"]]


def test_a_long_log_is_thinned_to_means(run: Path):
    (run / "progress.csv").write_text(log(1000))
    few = read_log(run).thinned(100)
    assert few.steps.tolist() == [100 * i for i in range(10, 1001, 10)]
    np.testing.assert_allclose(few.signals[REWARD], 0.5 * np.arange(5.5, 1000, 10))
    assert np.isnan(few.signals["learning: std"]).all()


def test_half_written_lines_are_left_out(run: Path):
    for rest in ("", "400,8,2", "400,8,2,14,-4,-0.4", "400,8,2,14,-4,-0.4,0.", "\n\n", "1,2\n"):
        (run / "progress.csv").write_text(log(3) + rest)
        assert read_log(run).steps.tolist() == [100, 200, 300]
    for text in ("", HEADER, HEADER + "\n"):
        (run / "progress.csv").write_text(text)
        assert len(read_log(run).steps) == 0


def test_runs_are_found_in_a_folder_of_seeds(run: Path):
    (run.parent / "other").mkdir()
    assert find_runs(run.parent) == find_runs(run) == [run]
    with pytest.raises(ViewerError, match="or in its subfolders"):
        find_runs(run.parent / "other")


def test_the_newest_policy_counts(run: Path):
    names = ["checkpoints/policy_100.npz", "policy.npz", "policy.zip"]
    for age, name in enumerate([*names, "policy.learner.npz", ".policy.npz", "policy.json"]):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_bytes(b"")
        os.utime(run / name, (1000 + age, 1000 + age))
    assert newest_policy(run) == run / "policy.zip"
    os.utime(run / names[1], (2000, 2000))
    assert newest_policy(run) == run / names[1]
    assert newest_policy(run.parent) is None


class Watching:
    """The events of a page, as a browser gets them."""

    def __init__(self, url: str) -> None:
        where = urllib.parse.urlsplit(url)
        self._connection = http.client.HTTPConnection("127.0.0.1", where.port or 0, timeout=120)
        self._connection.request("GET", f"{where.path}events")
        self._answer = self._connection.getresponse()

    def next(self, kind: str, condition: Any = bool) -> Any:
        """The data of the next event of a kind that fulfils a condition."""
        found = "message"
        while True:
            line = self._answer.readline().decode()
            assert line, "the stream has ended"
            if line.startswith("event: "):
                found = line[7:-1]
            elif line.startswith("data: "):
                if found == kind and condition(data := json.loads(line[6:])):
                    return data
                found = "message"

    def close(self) -> None:
        self._connection.close()


@pytest.fixture
def watched(run: Path) -> Iterator[tuple[Path, Watching]]:
    with serving(Watcher([run])) as url:
        watching = Watching(url)
        yield run, watching
        watching.close()


@pytest.mark.slow
def test_the_page_gets_curves_and_the_present_policy(watched: tuple[Path, Watching]):
    run, events = watched
    curves = events.next("curves")
    assert [source["name"] for source in curves["sources"]] == ["run"]
    assert curves["span"] == [0, 300]
    state = events.next("message")["state"]
    assert (state["steps"], state["ended"], state["policy_steps"]) == (300, False, None)
    (run / "progress.csv").write_text(log(5))
    assert events.next("curves", lambda data: data["span"][1] == 500)
    policy(run / "policy.npz", steps=400)
    assert events.next("scene")
    state = events.next("message", lambda data: data["moves"])["state"]
    assert (state["policy_steps"], state["total"], state["ended"]) == (400, 600, False)
    assert (len(state["command"]), len(state["moves"])) == (3, 3)
    policy(run / "policy.npz", bias=-0.3, steps=500)
    events.next("message", lambda data: data["state"]["policy_steps"] == 500)
    policy(run / "policy.npz", steps=600, ended=True)
    state = events.next("message", lambda data: data["state"]["ended"])["state"]
    assert (state["finished"], state["notice"]) == (True, "")


@pytest.mark.slow
def test_policies_that_cannot_act_are_told(watched: tuple[Path, Watching]):
    run, events = watched
    (run / "policy.npz").write_bytes(b"no policy")
    assert "policy.npz" in events.next("message", lambda data: data["state"]["notice"])["state"]["notice"]
    policy(run / "policy.npz", env="my_module:some/Env-v0")
    told = events.next("message", lambda data: "--env" in data["state"]["notice"])["state"]
    assert "my_module" in told["notice"]
    policy(run / "policy.npz")
    assert events.next("scene")
    assert events.next("message", lambda data: data["state"]["notice"] == "")


def test_it_ends_with_its_input_and_leaves_nothing(tmp_path: Path):
    """As training starts it: before there is a folder; and ends it."""
    command = [sys.executable, "-m", "ce_gym", "watch", str(tmp_path / "later"), "--no-open", "--until-eof"]
    path = os.pathsep.join([str(ROOT), *sys.path])
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1].decode()
        port = urllib.parse.urlsplit(url).port or 0
        socket.create_connection(("127.0.0.1", port), timeout=60).close()
        process.stdin.close()
        assert process.wait(timeout=60) == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=60)


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium here: install chromium (Debian's package) to run this")
def test_the_page_in_a_browser(run: Path):
    policy(run / "policy.npz", ended=True)
    with serving(Watcher([run])) as url, Chromium(url, size=(500, 900)) as browser:
        browser.until("plots && received > 10 && find('waiting').style.display === 'none'")
        assert browser.run(
            "[...document.querySelectorAll('.plot')].map(plot => plot.querySelectorAll('select').length)"
        ) == [1, 1, 2]
        assert browser.run("find('steps').textContent") == "300 of 600 steps in 6 s, finished"
        browser.run("document.querySelector('.plot select').focus()")
        (run / "progress.csv").write_text(log(5))
        browser.until("find('steps').textContent.startsWith('500 ')")
        assert browser.run("document.activeElement === document.querySelector('.plot select')")
        assert browser.run("plots.csv().trim().split('\\n').length") == 6
        heights = "[viewer.renderer.domElement.clientHeight, find('pane').offsetHeight]"
        tall, pane = browser.run(heights)
        assert tall == pane
        assert not browser.errors
        assert [one for one in browser.requests if not one.startswith((url, "data:"))] == []
