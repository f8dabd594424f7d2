"""Robot files changed at random: each is a sound robot, or refused in one line."""

import time

import pytest
from changed_files import REFUSED, SOUND, assets_folder, case, outcome_of
from hypothesis import given, settings
from hypothesis import strategies as st

from ce_gym.dynamics.model import Model

pytest.importorskip("mujoco")


@settings(max_examples=80, derandomize=True, database=None, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_every_file_is_a_sound_robot_or_one_line(tmp_path_factory, seed):
    kind, outcome = case(seed, tmp_path_factory.mktemp("files"))
    assert outcome in (SOUND, REFUSED), f"seed {seed}: {kind}"


@pytest.mark.stress
def test_files_for_longer(tmp_path, minutes):
    end, seed, wrong = time.perf_counter() + 60 * minutes, 0, []
    while time.perf_counter() < end:
        kind, outcome = case(seed, tmp_path)
        wrong += [] if outcome in (SOUND, REFUSED) else [f"seed {seed}: {kind}: {outcome}"]
        seed += 1
    assert not wrong


def test_forces_that_do_not_come_back_are_noticed(monkeypatch):
    monkeypatch.setattr(Model, "forward_dynamics", lambda self, q, v, tau: 0.5 * tau)
    assert outcome_of(assets_folder() / "four_bar" / "four_bar.yaml") == "nonsense: forces do not come back"
