"""Read arguments of environments: `--env-arg KEY=VALUE`, or a mapping in a settings file."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import Any

from ce_gym.model.formats.reading import parse_yaml

RESERVED = {
    "act", "autoreset_mode", "device", "env", "env_id", "episodes", "id", "label", "model", "num_envs", "policy",
    "render_mode", "robots", "script", "seconds", "seed", "vector_kwargs", "vectorization_mode", "wrappers",
}  # fmt: skip
"""Arguments that have their own command-line options; records and settings must not contain them."""

DEEPEST = 20
"""Largest depth of nested lists and mappings in a value."""


def add_env_arg(parser: Any) -> None:
    """Add `--env-arg`, which collects pairs of name and value in `env_args`."""
    parser.add_argument(
        "--env-arg",
        dest="env_args",
        action="append",
        default=[],
        type=env_argument,
        metavar="KEY=VALUE",
        help="argument of the environment, such as terrain=stairs or 'randomise={\"friction\": [0.5, 1.2]}' "
        "(JSON or YAML); may be repeated",
    )


def add_env_arguments(parser: Any) -> None:
    """Add `--env` and `--env-arg` for programs that run a policy."""
    parser.add_argument(
        "--env",
        metavar="ID",
        help="environment to act in, such as my_module:ce_gym/MyRobotVelocity-v0 (default: as trained); a module that "
        "only the policy's file names is not imported",
    )
    add_env_arg(parser)


def env_argument(text: str) -> tuple[str, Any]:
    """Read `KEY=VALUE`, whose value is JSON or YAML.

    Raises:
        argparse.ArgumentTypeError: If the text has another form; one line that names the key.
    """
    key, equals, value = text.partition("=")
    if not (equals and key.strip().isidentifier()):
        raise argparse.ArgumentTypeError(f"{text[:200]!r}; expected KEY=VALUE, KEY the name of an argument")
    try:
        checked = checked_arguments({key.strip(): parse_yaml(value)})
    except ValueError as error:
        text = str(error)
        raise argparse.ArgumentTypeError(text if text.startswith(key.strip()) else f"{key.strip()}: {text}") from None
    return key.strip(), checked[key.strip()]


def checked_arguments(given: Any) -> dict[str, Any]:
    """Return a copy of an environment's arguments after checking that they are plain data.

    Raises:
        ValueError: If a value is not plain data, or a key has its own option; one line that names the key.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{repr(given)[:200]}; expected arguments of the environment by name")
    for key, value in given.items():
        if not isinstance(key, str) or key in RESERVED:
            raise ValueError(f"{key}: expected an argument of the environment alone")
        if not _is_plain(value):
            raise ValueError(f"{key}: {repr(value)[:200]}; expected finite numbers, text, true, false, lists, mappings")
    return dict(given)


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Return whether a value consists of finite numbers, text, booleans, None, lists and mappings."""
    if depth > DEEPEST:
        return False
    if isinstance(value, list | tuple):
        return all(_is_plain(item, depth + 1) for item in value)
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item, depth + 1) for key, item in value.items())
    return value is None or isinstance(value, str | bool | int) or (isinstance(value, float) and math.isfinite(value))
