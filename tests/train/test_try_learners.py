"""Other people's learners are watched: what comes of an episode is noted, and what cannot be installed is skipped."""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import try_learners
from try_learners import Missing, main, progress, train

OTHERS = Path(try_learners.__file__).parent / "others"


def test_returns_of_single_and_batched_robots_are_noted(tmp_path, monkeypatch):
    """Each line is the sum of the rewards that were given until an episode ended."""
    monkeypatch.syspath_prepend(OTHERS)
    monkeypatch.setenv("WATCHED_FILE", str(tmp_path / "returns.txt"))
    import watched

    env = watched.make(max_episode_steps=3)
    env.reset(seed=0)
    total = sum(env.step(np.zeros(12, np.float32))[1] for _ in range(3))
    native = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "max_episode_steps": 3}
    envs = gymnasium.make_vec("watched/Stand-v0", 2, **native)
    envs.reset(seed=0)
    totals = sum(envs.step(np.zeros((2, 12), np.float32))[1] for _ in range(3))
    noted = [float(line) for line in (tmp_path / "returns.txt").read_text().splitlines()]
    np.testing.assert_allclose(noted, [total, *totals], rtol=1e-5)


def test_the_first_and_the_last_tenth_are_compared():
    assert progress([1.0] * 2 + [5.0] * 16 + [9.0] * 2) == (1.0, 9.0)
    assert np.isnan(progress([1.0] * 19)).all()


def test_a_learner_is_ended_and_one_that_fails_is_told(tmp_path):
    python = Path(sys.executable)
    write = "import os, time; open(os.environ['WATCHED_FILE'], 'w').write('1\\n2\\n'); time.sleep(600)"
    assert train(python, ["-c", write], 0.1, tmp_path) == ([1.0, 2.0], "")
    returns, told = train(python, ["-c", "raise ValueError('no such thing')"], 1.0, tmp_path)
    assert (returns, told) == ([], "ValueError: no such thing")


def test_what_cannot_be_installed_is_skipped(tmp_path, monkeypatch, capsys):
    def missing(*_):
        raise Missing("ERROR: no such package")

    monkeypatch.setattr("try_learners.python_of", missing)
    assert main(["skrl", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "skrl            skipped: not installable: ERROR: no such package\n"
    with pytest.raises(SystemExit):
        main(["sk"])
    assert "'sk': expected some of rl_zoo," in capsys.readouterr().err
