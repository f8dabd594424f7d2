"""Calls in any order, a fixed number of sequences; `python -m ce_gym.bench fuzz` goes on for longer."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tripod import TRIPOD

from ce_gym.bench.fuzz.sequences import Environments, Simulators, carry_out

PLACES = {
    "simulators": lambda: Simulators(TRIPOD),
    "environments": lambda: Environments(TRIPOD),
    "environments that begin one step later": lambda: Environments(TRIPOD, "NextStep"),
}


def calls(operations: tuple[str, ...]) -> st.SearchStrategy:
    return st.lists(st.tuples(st.sampled_from(operations), st.integers(0, 9999)), max_size=12)


@pytest.mark.parametrize("place", PLACES)
def test_robots_of_a_batch_are_as_they_are_alone(place: str):
    beside = PLACES[place]()

    @settings(max_examples=15, derandomize=True, database=None, deadline=None)
    @given(calls(beside.OPERATIONS))
    def sequence(chosen):
        carry_out(beside, chosen)

    sequence()


def test_a_robot_that_another_one_changes_is_noticed(monkeypatch: pytest.MonkeyPatch):
    beside = Simulators(TRIPOD)
    reset = beside.batch.reset
    monkeypatch.setattr(beside.batch, "reset", lambda mask: reset())  # forgets the mask
    with pytest.raises(AssertionError, match="Mismatched"):
        carry_out(beside, [("step", 0), ("reset", 1), ("step", 2), ("reset", 3)])


def test_a_divergence_happens():
    beside = Simulators(TRIPOD)
    carry_out(beside, [("diverge", 0), ("step", 1)])
    assert 0 < beside.batch.diverged.sum() < 9
    envs = Environments(TRIPOD)
    carry_out(envs, [("diverge", 0), ("step", 1)])
    assert 0 < envs.batch.n_diverged < 9
