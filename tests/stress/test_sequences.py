"""Calls in any order on a batch of robots: a fixed number of short sequences, and long ones at random."""

import random
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequences import Environments, Simulators, carry_out
from tripod import TRIPOD

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


@pytest.mark.stress
def test_sequences_for_longer(minutes):
    end, seed = time.perf_counter() + 60 * minutes, 0
    while time.perf_counter() < end:
        rng = random.Random(seed)
        kind = rng.choice(("simulators", "SameStep", "NextStep"))
        beside = Simulators("mini_cheetah") if kind == "simulators" else Environments("mini_cheetah", kind)
        carry_out(beside, [(rng.choice(beside.OPERATIONS), rng.randrange(10**6)) for _ in range(rng.randrange(60))])
        seed += 1
