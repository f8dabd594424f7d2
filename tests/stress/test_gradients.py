"""Gradients of steps between which other calls change the state, in any order: they stop where they must."""

import random
import time

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, StepDerivatives

N = 4
CALLS = ("record", "record", "record", "step", "reset", "set", "keep", "restore", "parts", "parameter", "refused")


class Recorded:
    """Robots whose steps are recorded.

    Attributes:
        since: For each robot, the number of recorded steps when its state was last changed by another call.
    """

    def __init__(self, model: Model, keep_every: int) -> None:
        self.sim = Simulator(model, N, parameters=("kp",))
        self.derivatives, self.kept = StepDerivatives(self.sim, keep_every), self.sim.snapshot()
        self.since = np.zeros(N, int)

    def call(self, name: str, seed: int) -> None:
        """Carry out a call."""
        sim, rng = self.sim, np.random.default_rng(seed)
        target, some = sim.model.standing_q[7:] + rng.normal(0, 0.1, (N, 2)), rng.random(N) < 0.5
        changed = np.zeros(N, bool)
        if name == "record":
            self.derivatives.step(target, int(rng.integers(1, 3)))
        elif name == "step":
            sim.step(target, n := int(rng.integers(2)))
            changed |= n > 0
        elif name == "reset":
            sim.reset(changed := some)
        elif name == "set":
            sim.set_state(sim.q, sim.v, changed := some)
        elif name == "keep":
            self.kept = sim.snapshot()
        elif name == "restore":
            sim.restore(self.kept)
            changed |= True
        elif name == "parts":
            self.derivatives.restore(self.derivatives.state())
            changed |= True
        elif name == "parameter":
            sim.set_parameter("kp", 50.0 * rng.random(2), some)
        else:
            for wrong in (lambda: self.derivatives.step([np.nan, 0.0]), lambda: sim.reset([0, 2, 1, 3])):
                with pytest.raises(ValueError, match=r"expected|finite"):
                    wrong()
        self.since[changed] = self.derivatives.n_recorded


def check_calls(model: Model, seed: int) -> None:
    """Make random calls, and compare recorders that keep every state and one of five.

    Raises:
        AssertionError: The gradients differ, or pass a change of the state.
    """
    rng = random.Random(seed)
    calls = [(rng.choice(CALLS), rng.randrange(10**6)) for _ in range(16)] + [("record", seed)]
    recorders = [Recorded(model, keep_every) for keep_every in (1, 5)]
    for name, number in calls:
        for recorder in recorders:
            recorder.call(name, number)
    weights = {"v": np.ones((N, model.nv))}
    (state, targets, _), (_, others, _) = (recorder.derivatives.backward(weights) for recorder in recorders)
    np.testing.assert_array_equal(targets, others)
    for robot, since in enumerate(recorders[0].since):
        assert not any(rows[robot].any() for rows in targets[:since])
        assert since == 0 or not any(rows[robot].any() for rows in state.values())
        assert targets[-1][robot].any()


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


@pytest.mark.parametrize("seed", range(8))
def test_gradients_stop_where_other_calls_change_the_state(model: Model, seed: int):
    check_calls(model, seed)


@pytest.mark.stress
def test_gradients_for_longer(model: Model, minutes):
    end, seed = time.perf_counter() + 60 * minutes, 1000
    while time.perf_counter() < end:
        check_calls(model, seed)
        seed += 1
