"""A step is all or nothing, whatever Ctrl-C and other threads do meanwhile."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator
from ce_gym.sim import interruptible_runs

N = 12
SEEN = ("q", "v", "torque", "contact_forces", "diverged")

FREED_TOO_EARLY = """
import gc, os, signal, threading, time
import ce_gym

model = ce_gym.Model("mini_cheetah")
target = model.standing_q[7:]
busy, freed = ce_gym.Simulator(model, 64, num_threads=os.cpu_count()), ce_gym.Simulator(model, 20_000, num_threads=2)
freed.step(target)
other = threading.Thread(target=busy.step, args=(target, 50_000))
other.start()
time.sleep(0.1)
threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    freed.step(target)
    time.sleep(60)
except KeyboardInterrupt:
    pass
del freed
gc.collect()
other.join()
busy.step(target)
print("alive")
"""
"""The threads are busy with one simulator while a second one's call waits for them, is interrupted and deleted."""


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


def moving(model: Model, **options) -> Simulator:
    """Robots that fall, slide and land."""
    sim = Simulator(model, N, **options)
    rng = np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (N, 1)), rng.normal(0, 0.5, (N, model.nv))
    q[:, 2] += np.linspace(0.0, 0.1, N)
    sim.set_state(q, v)
    return sim


def seen(sim: Simulator) -> bytes:
    return b"".join(getattr(sim, name).tobytes() for name in SEEN)


def watch(sim: Simulator, monkeypatch: pytest.MonkeyPatch, interrupted: int = 0, meanwhile=lambda: None) -> list[int]:
    """Split calls into pieces of three sub-steps, and send Ctrl-C during one piece.

    Args:
        sim: What makes the calls.
        monkeypatch: Undoes it.
        interrupted: Number of the piece, from 1.
        meanwhile: Called in each piece.

    Returns:
        The lengths of the pieces, to be looked at later.
    """
    kernel, lengths = sim._kernel, []

    def watched(arrays, num_envs, repeats, **options):
        lengths.append(repeats["n_substeps"])
        meanwhile()
        if len(lengths) == interrupted:
            signal.raise_signal(signal.SIGINT)
        kernel(arrays, num_envs, repeats=repeats, **options)

    monkeypatch.setattr(sim, "_kernel", watched)
    monkeypatch.setattr(interruptible_runs, "LONGEST", 3)
    return lengths


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are sent otherwise here")
def test_no_memory_is_freed_that_a_thread_still_writes_to():
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536"}  # freed memory is returned immediately
    command = [sys.executable, "-c", FREED_TOO_EARLY]
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (finished.returncode, finished.stdout) == (0, "alive\n"), finished.stderr


@pytest.mark.parametrize("options", [{}, {"method": "extrapolated"}, {"dtype": "float32"}], ids=str)
def test_a_call_in_pieces_moves_alike(model: Model, options: dict, monkeypatch: pytest.MonkeyPatch):
    """Momentum is rounded where a piece begins, so bits differ."""
    whole, split = (moving(model, **options) for _ in range(2))
    whole.step(model.standing_q[7:], 10)
    lengths = watch(split, monkeypatch)
    split.step(model.standing_q[7:], 10)
    assert lengths == [3, 3, 3, 1]
    for name in ("q", "v"):
        ours, theirs = getattr(split, name), getattr(whole, name)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e4 * np.finfo(ours.dtype).eps)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_long_call_is_taken_back(model: Model, threads: int, monkeypatch: pytest.MonkeyPatch):
    sim, twin = moving(model, num_threads=threads), moving(model)
    lengths = watch(sim, monkeypatch, interrupted=2)
    before = seen(sim)
    with pytest.raises(KeyboardInterrupt):
        sim.step(model.standing_q[7:], 10)
    assert lengths == [3, 3]
    assert seen(sim) == before
    for one in (sim, twin):
        one.step(model.standing_q[7:], 10)
    assert seen(sim) == seen(twin), "something hidden was left changed"


@pytest.mark.parametrize("n_substeps", [2, 10])
def test_a_call_that_is_nearly_over_is_finished(model: Model, n_substeps: int, monkeypatch: pytest.MonkeyPatch):
    sim, twin = moving(model), moving(model)
    watch(sim, monkeypatch, interrupted=-(-n_substeps // 3))
    with pytest.raises(KeyboardInterrupt):
        sim.step(model.standing_q[7:], n_substeps)
    twin.step(model.standing_q[7:], n_substeps)
    assert seen(sim) == seen(twin)


def test_a_handler_that_goes_on_lets_the_call_go_on(model: Model, monkeypatch: pytest.MonkeyPatch):
    sim, twin, heard = moving(model), moving(model), []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(1))
    try:
        watch(sim, monkeypatch, interrupted=2)
        sim.step(model.standing_q[7:], 10)
    finally:
        signal.signal(signal.SIGINT, before)
    twin.step(model.standing_q[7:], 10)
    assert heard == [1]
    assert seen(sim) == seen(twin)


@pytest.mark.parametrize("call", ["step", "set_state", "reset", "set_parameter"])
def test_a_second_thread_is_refused(model: Model, call: str, monkeypatch: pytest.MonkeyPatch):
    sim, twin = (moving(model, parameters=("friction",)) for _ in range(2))
    sim.step(model.standing_q[7:])
    given = {
        "step": (model.standing_q[7:],),
        "set_state": (model.standing_q, np.zeros(model.nv)),
        "reset": (),
        "set_parameter": ("friction", 0.1),
    }
    errors = []

    def other():
        with pytest.raises(RuntimeError) as caught:
            getattr(sim, call)(*given[call])
        errors.append(str(caught.value))

    def meanwhile():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    watch(sim, monkeypatch, meanwhile=meanwhile)
    sim.step(model.standing_q[7:])
    assert errors == ["Simulator of 12 tripod: called during another call, expected one call at a time"]
    for _ in range(2):
        twin.step(model.standing_q[7:])
    assert seen(sim) == seen(twin)
