"""Robot files changed in their structure, a fixed number of them; `python -m ce_gym.bench fuzz` goes on for longer."""

from importlib.util import find_spec

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ce_gym.bench.fuzz import benchmark as fuzz


@pytest.mark.skipif(find_spec("mujoco") is None, reason="needs mujoco")
@settings(max_examples=80, derandomize=True, database=None, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_every_file_is_a_sound_robot_or_one_line(tmp_path_factory, seed):
    kind, outcome = fuzz.case(seed, tmp_path_factory.mktemp("fuzz"))
    assert outcome in (fuzz.SOUND, fuzz.REFUSED), f"seed {seed}: {kind}"


def test_what_is_neither_is_told(tmp_path, monkeypatch):
    def broken(path):
        raise KeyError("inside")

    monkeypatch.setattr(fuzz, "load_robot", broken)
    assert fuzz.outcome_of(tmp_path / "r.yaml") == "KeyError: 'inside'"
    monkeypatch.undo()
    monkeypatch.setattr(fuzz.Model, "forward_dynamics", lambda self, q, v, tau: 0.5 * tau)
    path = fuzz.assets_folder() / "four_bar" / "four_bar.yaml"
    assert fuzz.outcome_of(path) == "nonsense: forces do not come back"
