"""The text of a live page."""

from __future__ import annotations

import json
from pathlib import Path

from ce_gym.viewer.live.robot import RANGES
from ce_gym.viewer.live.runner import Runner
from ce_gym.viewer.live.setup import GROUNDS, LEVELS
from ce_gym.viewer.page.html import filled

_HERE = Path(__file__).parent


def live_page(runner: Runner, title: str | None = None) -> str:
    """Return the live page of a runner.

    Args:
        runner: The runner of the session.
        title: Heading; the robot's name by default.

    Raises:
        ViewerError: meshcat is not installed.
    """
    scene = runner.scene
    return filled(
        _HERE / "live.html",
        title or scene.robot.name,
        live=(_HERE / "live.js").read_text(encoding="utf-8"),
        commands=json.dumps(scene.commands()),
        offer=json.dumps(_offer(runner)).replace("<", "\\u003c"),  # a name must not end the script
    )


def _offer(runner: Runner) -> dict[str, object]:
    policies = [(name, Path(name).stem if Path(name).suffix else name) for name in runner.offered]
    levels = [(name, name) for name in LEVELS]
    choices = {
        "policy": [*policies, ("", "none: hold the pose")],
        "transmission": levels,
        "ghost": [("", "none"), *levels],
        "terrain": [(name, name) for name in GROUNDS],
    }
    bodies = {path: name for name, path in runner.scene.paths[0].items()}
    return {"choices": choices, "figures": RANGES, "bodies": bodies}
