"""The check of registered ids: silent on one that is right, and it says what is wrong with one that is not."""

from __future__ import annotations

from argparse import Namespace

import gymnasium
import pytest

import ce_gym
from ce_gym.bench.soak import ids

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"


@pytest.fixture
def wrong():
    """An id whose observations are not in its space."""

    class Wrong(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1, 1, (2,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return 7 + self.observation_space.sample(), {}

        def step(self, action):
            return self.reset()[0], 0.0, False, False, {}

    gymnasium.register("Wrong-v0", Wrong)
    yield "Wrong-v0"
    del gymnasium.registry["Wrong-v0"]


def test_an_id_that_is_right():
    report = ids.run(Namespace(pattern=VELOCITY))
    assert not report.failed
    assert report.tables[0].rows == ()
    with pytest.raises(ValueError, match="a pattern that fits an id"):
        ids.run(Namespace(pattern="*Cheetha*"))


def test_an_id_that_is_wrong(wrong, monkeypatch):
    monkeypatch.setattr(ce_gym, "environment_ids", lambda: {wrong: {}})
    report = ids.run(Namespace(pattern="*"))
    assert report.failed
    assert [row[:2] for row in report.tables[0].rows] == [(wrong, "gymnasium"), (wrong, "stable_baselines3")]
