"""Ctrl-C at every line of a step or reset, and other threads meanwhile: a call is made whole, or not at all."""

from __future__ import annotations

import signal
import sys
import threading
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import ce_gym

PACKAGE = str(Path(ce_gym.__file__).parent)
ID = "ce_gym/MiniCheetahVelocity-v0"
SIZE = 3


def single(**options) -> Any:
    return gymnasium.make(ID, **options).unwrapped


def vector(mode: str = "SameStep", **options) -> Any:
    """Episodes of two steps, so that robots are reset in every step."""
    envs: Any = gymnasium.make_vec(ID, num_envs=SIZE, max_episode_steps=2, autoreset_mode=mode, **options).unwrapped
    envs.reset(seed=0)
    envs.elapsed_steps = np.arange(SIZE) % 2
    return envs


def seen(env: Any) -> dict[str, bytes]:
    """All that later steps depend on, and counts."""
    state = {**env.snapshot(), "generator": np.array(str(env.np_random.bit_generator.state))}
    return {name: values.tobytes() for name, values in state.items()}


class AtLine:
    """Ctrl-C comes before the line of the package that is reached as number `n` inside `with`."""

    def __init__(self, n: int) -> None:
        self.left = n

    def __enter__(self) -> None:
        sys.settrace(self._call)

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _call(self, frame: Any, event: str, argument: object) -> Any:
        return self._line if frame.f_code.co_filename.startswith(PACKAGE) else None

    def _line(self, frame: Any, event: str, argument: object) -> Any:
        if event == "line":
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                signal.raise_signal(signal.SIGINT)
        return self._line


def act(env: Any, number: int) -> None:
    env.step(np.full(env.action_space.shape, np.sin(number), np.float32))


def begin(env: Any, number: int) -> None:
    env.reset(seed=number)


def command(env: Any, number: int) -> None:
    env.set_command([0.1 * number, 0.0, 0.0])


def count(env: Any, number: int) -> None:
    env.elapsed_steps = np.full(SIZE, number)


EVERY_CALL = [*product((single, vector), (act, begin, command)), (vector, count)]


@pytest.mark.parametrize("call", [act, begin])
@pytest.mark.parametrize("make", [single, vector, lambda: vector("NextStep"), lambda: vector(num_threads=2)])
def test_ctrl_c_at_any_line(make, call):
    """After Ctrl-C the environment is as before the call or as after it, and goes on as its twin does."""
    env, twin = make(), make()
    for one in (env, twin):
        begin(one, 0)
    outcomes, interruption = [], AtLine(0)
    while interruption.left <= 0:
        before, interruption = seen(twin), AtLine(len(outcomes) + 1)
        call(twin, len(outcomes))
        try:
            with interruption:
                call(env, len(outcomes))
        except KeyboardInterrupt:
            pass
        outcomes.append(seen(env) != before)
        if not outcomes[-1]:
            call(env, len(outcomes) - 1)
        assert seen(env) == seen(twin), f"line {len(outcomes)}"
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert outcomes.count(False) > 3, "interrupted before it was made"
    assert outcomes.count(True) > 20, "interrupted when it had to be finished"


@pytest.mark.parametrize(("make", "call"), EVERY_CALL)
def test_a_second_thread_is_refused(make, call, monkeypatch: pytest.MonkeyPatch):
    env, twin, errors = make(), make(), []
    kernel = env.batch._step_kernel

    def other():
        with pytest.raises(RuntimeError) as caught:
            call(env, 1)
        errors.append(str(caught.value))

    def watched(*arguments, **options):
        env.batch._step_kernel = kernel  # what is not refused ends, too
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        kernel(*arguments, **options)

    for one in (env, twin):
        begin(one, 0)
    monkeypatch.setattr(env.batch, "_step_kernel", watched)
    for one in (env, twin):
        act(one, 1)
    name = f"{type(env).__name__} 'velocity' of {env.batch.num_envs} mini_cheetah"
    assert errors == [f"{name}: called during another call, expected one call at a time"]
    assert seen(env) == seen(twin)


@pytest.mark.parametrize(("make", "call"), EVERY_CALL)
def test_what_is_closed_is_not_stepped(make, call):
    env = make()
    begin(env, 0)
    for _ in range(2):
        env.close()
    with pytest.raises(
        gymnasium.error.ClosedEnvironmentError, match=r"^L.*Env 'velocity' of . mini_cheetah: .*close\(\)"
    ):
        call(env, 1)
