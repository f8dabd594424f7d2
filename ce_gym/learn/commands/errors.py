"""Errors of the commands as one line, which begins with the option that was wrong."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from typing import Any

import gymnasium

from ce_gym.console import InputError, file_error
from ce_gym.learn.runs.settings import GIVEN
from ce_gym.policies import find_policy

EXTRAS = {
    "numba": "train", "tqdm": "train", "threadpoolctl": "train", "stable_baselines3": "sb3", "mujoco": "mjcf",
    "meshcat": "viewer", "onnx": "export", "onnxruntime": "export",
}  # fmt: skip
"""Extra of ce_gym that installs an optional package."""

UNKNOWN_ARGUMENT = "unexpected keyword argument"
"""Message of Python about a wrong name in `--env-arg`, if an environment does not check names."""

FILES = ("config", "resume", "out", "json")
"""Options whose values are files or folders."""


def in_one_line(work: Callable[..., int]) -> Callable[..., int]:
    """Return a command whose errors about values of the user are `InputError`, with matrix products on one thread."""

    @functools.wraps(work)
    def command(*args: argparse.Namespace) -> int:
        try:
            with _one_thread():
                return work(*args)
        except ModuleNotFoundError as error:
            raise InputError(_missing(error)) from error
        except MemoryError as error:
            raise InputError(f"not enough memory: {_line(error)}") from error
        except BrokenPipeError:
            raise
        except OSError as error:
            raise InputError(_with_option(file_error(error), *args)) from error
        except (ValueError, TypeError, gymnasium.error.Error) as error:
            if isinstance(error, TypeError) and UNKNOWN_ARGUMENT not in str(error):
                raise
            raise InputError(_with_option(_line(error), *args)) from error

    return command


def _with_option(message: str, *namespaces: argparse.Namespace) -> str:
    """Return an error that begins with the option whose value it is about, if it is about an option."""
    options = {name: value for args in namespaces for name, value in vars(args).items()}
    if message.startswith(f"{GIVEN}: "):
        return message.replace(f"{GIVEN}: ", "--set ", 1)
    files = {name: str(value) for name, value in options.items() if name in FILES and value not in (None, "-")}
    if "resume" in files and (policy := find_policy(files["resume"])):
        files["resume"] = str(policy.with_suffix(""))
    for name, file in files.items():
        if message.startswith(file):
            return f"--{name} {message}"
    for key, _ in options.get("env_args", ()):
        if message.startswith(key):
            return f"--env-arg {message}"
        if f"{UNKNOWN_ARGUMENT} {key!r}" in message:
            return f"--env-arg {key}: {message}"
    return message


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


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
    if error.name is None:  # the module of an environment's id, which no package provides
        return _line(error)
    package = error.name.split(".")[0]
    if package == "ce_gym":
        raise error
    how = f"ce_gym[{EXTRAS[package]}]" if package in EXTRAS else package
    return f'needs {package}, which is not installed: pip install "{how}"'
