"""Errors of the commands as one line."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import gymnasium

from ce_gym.console import InputError

EXTRAS = {
    "numba": "train", "tqdm": "train", "threadpoolctl": "train", "stable_baselines3": "sb3", "mujoco": "mjcf",
    "meshcat": "viewer", "onnx": "export", "onnxruntime": "export",
}  # fmt: skip
"""Extra of ce_gym that installs an optional package."""

UNKNOWN_ARGUMENT = "unexpected keyword argument"
"""Message of Python about a wrong name in `--env-arg`, if an environment does not check names."""


def in_one_line(work: Callable[..., int]) -> Callable[..., int]:
    """Return a command whose errors about values of the user are `InputError`, with matrix products on one thread."""

    @functools.wraps(work)
    def command(*args: Any) -> int:
        try:
            with _one_thread():
                return work(*args)
        except ModuleNotFoundError as error:
            raise InputError(_missing(error)) from error
        except MemoryError as error:
            raise InputError(f"not enough memory: {' '.join(str(error).split())}") from error
        except (ValueError, TypeError, gymnasium.error.Error) as error:
            if isinstance(error, TypeError) and UNKNOWN_ARGUMENT not in str(error):
                raise
            raise InputError(" ".join(str(error).split())) from error

    return command


def _one_thread() -> Any:
    """Return a context in which numpy multiplies matrices on one thread.

    Layers of a policy are too small for several threads, and waiting threads use processor time: 512 episodes of 20 s
    take 18 to 20 s of processor time with two threads and 7 s with one.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1, "blas")


def _missing(error: ModuleNotFoundError) -> str:
    """Return which package is missing and how to install it.

    Raises:
        ModuleNotFoundError: If the missing module belongs to ce_gym.
    """
    if error.name is None:  # Gymnasium's error about the module of an id
        return " ".join(str(error).split())
    package = error.name.split(".")[0]
    if package == "ce_gym":
        raise error
    how = f"ce_gym[{EXTRAS[package]}]" if package in EXTRAS else package
    return f'needs {package}, which is not installed: pip install "{how}"'
