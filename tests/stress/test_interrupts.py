"""Ctrl-C at random moments of steps, on one to four threads: each call must have been made whole, or not at all.

Simulators and environments are interrupted beside twins that are not. After Ctrl-C each must be where its twin was
before the call, or where it is after it; the step is then made up for, so that whatever is hidden shows later. Nobody
may write any more once the call is over. A use after free would end this process.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

ROBOT, ENVIRONMENT = "mini_cheetah", "ce_gym/MiniCheetahVelocity-v0"
NUM_ENVS = 200
EPISODE = 4
"""Control steps until time is up: nearly every call then resets some robots too."""
THREADS = (1, 2, 3, 4)
LONG = 10**6
"""Sub-steps of the call that has to answer soon."""
SOON = 1.0
"""How long that may take [s]."""


@dataclass
class Case:
    """Something that steps, and its twin.

    Attributes:
        name: Name, with the number of threads.
        pair: The interrupted simulator or environment, and its twin.
        step: Makes a step of either, given random inputs.
        look: Returns its visible state, by name.
        draw: Draws random inputs of a step.
        before, after: Interrupted calls that were undone, and calls that were completed.
        complaints: Errors found, one line each.
    """

    name: str
    pair: tuple[Any, Any]
    step: Callable[[Any, NDArray], Any]
    look: Callable[[Any], dict[str, NDArray]]
    draw: Callable[[np.random.Generator], NDArray]
    before: int = 0
    after: int = 0
    complaints: list[str] = field(default_factory=list)

    def interrupt(self, rng: np.random.Generator) -> None:
        """Interrupt one step at a random moment, and check the state that it leaves."""
        subject, twin = self.pair
        before, given = self.look(twin), self.draw(rng)
        started = time.perf_counter()
        self.step(twin, given)
        seconds = time.perf_counter() - started
        interrupted(lambda: self.step(subject, given), rng.uniform(0, 1.5) * seconds)
        left = self.look(subject)
        time.sleep(0.002)
        if not same(self.look(subject), left):
            self.complaints.append(f"{self.name}: somebody writes after the call")
        if same(left, before):
            self.before += 1
            self.step(subject, given)
        elif same(left, self.look(twin)):
            self.after += 1
        if not same(self.look(subject), self.look(twin)):
            self.complaints.append(f"{self.name}: neither before the call nor after it")


@pytest.mark.stress
def test_each_call_is_made_whole_or_not_at_all(minutes: float):
    rng, end = np.random.default_rng(0), time.monotonic() + 60 * minutes
    cases = [make(threads) for threads in THREADS for make in (short_steps, long_steps, same_step, next_step)]
    while time.monotonic() < end:
        for case in cases:
            case.interrupt(rng)
    assert not [text for case in cases for text in case.complaints]
    assert all(sum(getattr(case, name) for case in cases) for name in ("before", "after"))


@pytest.mark.stress
def test_a_long_call_answers_soon():
    seconds, unharmed = long_call()
    assert unharmed
    assert seconds < SOON


def short_steps(threads: int) -> Case:
    """Steps of a simulator that are finished before Ctrl-C is heard."""
    return simulators(f"simulator, 4 sub-steps, {threads} threads", threads, 4)


def long_steps(threads: int) -> Case:
    """Steps of a simulator that are made in pieces, and taken back."""
    return simulators(f"simulator, 1500 sub-steps, {threads} threads", threads, 1500)


def simulators(name: str, threads: int, n_substeps: int) -> Case:
    """Return two simulators of a robot under random targets about its standing pose."""
    from ce_gym import Model, Simulator

    model = Model(ROBOT)
    pair = Simulator(model, NUM_ENVS, num_threads=threads), Simulator(model, NUM_ENVS)
    seen, n = ("q", "v", "torque", "contact_forces", "diverged"), len(model.standing_q) - 7
    return Case(
        name,
        pair,
        lambda sim, target: sim.step(target, n_substeps),
        lambda sim: {name: getattr(sim, name) for name in seen},
        lambda rng: model.standing_q[7:] + rng.normal(0, 0.2, (NUM_ENVS, n)),
    )


def same_step(threads: int) -> Case:
    """Environments that are reset in the step that ends an episode."""
    return environments("SameStep", threads)


def next_step(threads: int) -> Case:
    """Environments that are reset in the step after it."""
    return environments("NextStep", threads)


def environments(mode: str, threads: int) -> Case:
    """Return two batches of short episodes under random actions."""
    import gymnasium

    options: dict[str, Any] = {"num_envs": NUM_ENVS, "max_episode_steps": EPISODE, "autoreset_mode": mode}
    pair: Any = tuple(gymnasium.make_vec(ENVIRONMENT, num_threads=n, **options).unwrapped for n in (threads, 1))
    for envs in pair:
        envs.reset(seed=0)
        envs.elapsed_steps = np.arange(NUM_ENVS) % EPISODE  # so that episodes do not all end together
    return Case(
        f"environments, {mode}, {threads} threads",
        pair,
        lambda envs, actions: envs.step(actions),
        lambda envs: (
            {name: envs.batch.rows(name) for name in envs.batch.program.state_sizes}
            | {"elapsed": envs.elapsed_steps, "diverged": np.array(envs.n_diverged)}
        ),
        lambda rng: rng.uniform(-1, 1, pair[0].action_space.shape).astype(np.float32),
    )


def long_call() -> tuple[float, bool]:
    """Return how long a call of a million sub-steps takes to answer [s], and whether the state is as before it."""
    from ce_gym import Model, Simulator

    sim = Simulator(Model(ROBOT), 1)
    q, v = sim.q, sim.v
    seconds = interrupted(lambda: sim.step(sim.model.standing_q[7:] + 0.1, LONG), 0.2)
    return seconds, same({"q": q, "v": v}, {"q": sim.q, "v": sim.v})


def interrupted(call: Callable[[], Any], delay: float) -> float:
    """Make a call, send Ctrl-C to this process after `delay` seconds, and wait for it.

    Returns:
        Time from when it was sent until it was raised [s].
    """
    sent: list[float] = []

    def send() -> None:
        time.sleep(delay)
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=send)
    try:
        sender.start()
        call()
        while True:
            time.sleep(0.001)
    except KeyboardInterrupt:
        seconds = time.perf_counter() - sent[0]
    sender.join()
    return seconds


def same(one: dict[str, NDArray], other: dict[str, NDArray]) -> bool:
    """Return whether two states are equal, bit for bit."""
    return all(values.tobytes() == other[name].tobytes() for name, values in one.items())
