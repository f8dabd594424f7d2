"""Rollouts -> one HTML file that plays them: no server, no network, nothing beside it.

Knows the scene's commands and where meshcat keeps its page's code; meshcat itself is not even imported.
"""

from __future__ import annotations

import base64
import html
import importlib.util
import json
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ce_gym.viewer import arrows, three
from ce_gym.viewer.actor import PosedModel
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.rollout import Rollout
from ce_gym.viewer.scene import GHOST_TINTS, build_scene
from ce_gym.viewer.stage import HORIZON

_PLAYER = Path(__file__).with_name("player.html")


def page(
    rollouts: Rollout | Sequence[Rollout],
    *,
    title: str | None = None,
    models: Sequence[PosedModel] | None = None,
    spacing: float | None = None,
    max_fps: float = 50.0,
) -> str:
    """Return a self-contained HTML page with play, pause, scrub and speed.

    Args:
        rollouts: What to show; several stand side by side.
        title: Heading of the page; by default the robots' names.
        models: A posed model for each rollout; built from the rollouts' robots if not given.
        spacing: Distance between neighbours [m]; zero overlays the others as ghosts. By default neighbours keep clear
            of each other.
        max_fps: Frames beyond this rate are left out [1/s].

    Raises:
        ViewerError: meshcat is not installed, or a rollout does not fit its robot.
    """
    rollouts = [rollouts] if isinstance(rollouts, Rollout) else list(rollouts)
    code = meshcat_code()
    commands = build_scene(rollouts, models, spacing=spacing, max_fps=max_fps)
    packed = [base64.b64encode(three.pack(command)).decode() for command in commands]
    title = title or " / ".join(dict.fromkeys(rollout.robot for rollout in rollouts))
    return string.Template(_PLAYER.read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        legend=_legend(rollouts, ghosts=spacing == 0),
        meshcat=code,
        commands=json.dumps(packed),
        frame=repr(max(rollouts[0].dt, 1.0 / max_fps)),
        horizon=three.hex_color(HORIZON),
    )


def write_html(rollouts: Rollout | Sequence[Rollout], path: str | Path, **options: Any) -> Path:
    """Write the page of rollouts to a file and return its path; see `page` for the options."""
    path = Path(path)
    path.write_text(page(rollouts, **options), encoding="utf-8")
    return path


def meshcat_code() -> str:
    """Return the code of meshcat's page.

    Raises:
        ViewerError: meshcat is not installed.
    """
    spec = importlib.util.find_spec("meshcat")
    if spec is None or spec.origin is None:
        raise ViewerError.missing_meshcat()
    return Path(spec.origin).with_name("viewer").joinpath("dist", "main.min.js").read_text(encoding="utf-8")


def _legend(rollouts: Sequence[Rollout], *, ghosts: bool) -> str:
    """Return list items: what each robot is, left to right, and what the arrows mean."""
    items = []
    for index, rollout in enumerate(rollouts):
        text = rollout.label or f"{Path(rollout.robot).stem}, {rollout.transmission} transmission"
        items.append((_css(GHOST_TINTS[(index - 1) % len(GHOST_TINTS)]) if ghosts and index else None, text))
    if any(rollout.contact_forces.shape[1] for rollout in rollouts):
        items.append((_css(arrows.FORCE_COLOR), "contact forces"))
    if any(rollout.commands.shape[1] >= 2 for rollout in rollouts):
        items += [(_css(arrows.COMMAND_COLOR), "commanded speed"), (_css(arrows.VELOCITY_COLOR), "actual speed")]
    dots = [f'<i style="background:{color}"></i>' if color else "" for color, _ in items]
    return "".join(f"<li>{dot}{html.escape(text)}</li>" for dot, (_, text) in zip(dots, items, strict=True))


def _css(color: three.Color) -> str:
    return f"#{three.hex_color(color):06x}"
