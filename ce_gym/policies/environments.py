"""The environment of a policy whose file is not trusted.

Gymnasium imports `module` when an environment `module:id` is made. So an id with a module is taken from the user's own
words only, never from a file, unless the module is imported already.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import gymnasium

from ce_gym.policies.errors import PolicyError


def environment_of(record: Mapping[str, Any], named: str | None = None) -> str:
    """Return the id of the environment that a policy runs in.

    Args:
        record: Of the policy.
        named: What the user named, such as `my_module:ce_gym/MyRobotVelocity-v0`; it goes before the record.

    Raises:
        PolicyError: If the record names an environment that is not registered, or one for which a module would have to
            be imported.
    """
    if named:
        return named
    env_id = record["env"]
    module, _, name = env_id.rpartition(":")
    if module not in ("", "ce_gym") and module not in sys.modules:
        raise PolicyError(
            f"environment {env_id!r}: named by the policy's file, would import the module {module!r}; "
            f"if you trust it, name it yourself: --env {shown(env_id)}"
        )
    if name not in gymnasium.registry:
        raise PolicyError(
            f"environment {env_id!r}: not registered; expected one of this package's (see `list`), "
            f"or the module that registers it: --env MODULE:{shown(name)}"
        )
    return env_id


def shown(text: str) -> str:
    """Return text as a terminal may show it."""
    return "".join(c if c.isprintable() else "?" for c in text)
