"""Robots and tasks of other installed packages.

A package names the modules that register them as entry points:

    [project.entry-points."ce_gym.robots"]
    my_robot = "my_lab.robots"  # calls ce_gym.register_robot

    [project.entry-points."ce_gym.tasks"]
    crouch = "my_lab.tasks"  # calls ce_gym.register_task

`import ce_gym` imports these modules, so that their ids exist in every process, also in workers.
`python -m ce_gym project` writes such a package.
"""

from __future__ import annotations

import warnings
from importlib.metadata import entry_points

GROUPS = ("ce_gym.robots", "ce_gym.tasks")
"""Groups of entry points, in the order of loading: tasks name robots."""


class PluginWarning(UserWarning):
    """A module of an entry point cannot be imported, so its robots or tasks are missing."""


def load_plugins() -> None:
    """Import the modules of all entry points.

    Warns:
        PluginWarning: A module cannot be imported; the others still are.
    """
    for group in GROUPS:
        for entry in entry_points(group=group):
            try:
                entry.load()
            except Exception as error:
                reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
                text = f"entry point {entry.name!r} of {group}: {entry.value} cannot be imported: {reason}"
                warnings.warn(text, PluginWarning, stacklevel=3)
