"""Rollouts -> one self-contained HTML file that plays them, without server or network."""

from __future__ import annotations

import base64
import html
import importlib.util
import json
import string
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page import arrows, three
from ce_gym.viewer.page.charts import charts, chosen, packed
from ce_gym.viewer.page.lights_and_camera import HORIZON
from ce_gym.viewer.page.poses import PosedModel, PosedRollout
from ce_gym.viewer.page.scene import GHOST_TINTS, ROW, build_scene, pose_rollouts
from ce_gym.viewer.rollouts.rollout import Rollout

HERE = Path(__file__).parent
FIRST_COLOR = (0.15, 0.20, 0.27)
OTHERS_COLOR = (0.62, 0.66, 0.70)
LARGE = 5_000_000
"""Bytes beyond which a page says why."""


def page(
    rollouts: Rollout | Sequence[Rollout],
    *,
    title: str | None = None,
    models: Sequence[PosedModel] | None = None,
    spacing: float | None = None,
    plot: Sequence[str] = (),
    max_fps: float | None = None,
) -> str:
    """Return a self-contained HTML page with play, pause, scrub and speed, and plots beside the robots.

    Args:
        rollouts: What to show; several stand side by side, many in a square.
        title: Heading of the page; by default the robots' names.
        models: A posed model for each rollout; built from the rollouts' robots if not given.
        spacing: Distance between neighbours [m]; zero overlays the others as ghosts. By default neighbours keep clear
            of each other.
        plot: Names or beginnings of the names of signals to plot at first; any other can be chosen in the page.
        max_fps: Frames beyond this rate are left out [1/s]; 50 by default, 25 for more robots than stand in a row.

    Raises:
        ViewerError: meshcat is not installed, a rollout does not fit its robot, or there is no such signal.
    """
    return _made(rollouts, title, models, spacing, plot, max_fps)[0]


def _made(
    rollouts: Rollout | Sequence[Rollout],
    title: str | None = None,
    models: Sequence[PosedModel] | None = None,
    spacing: float | None = None,
    plot: Sequence[str] = (),
    max_fps: float | None = None,
) -> tuple[str, dict[str, int]]:
    """Return the page, and how many of its characters are what; see `page`."""
    rollouts = [rollouts] if isinstance(rollouts, Rollout) else list(rollouts)
    meshcat_code()  # fails before anything is computed if meshcat is missing
    max_fps = max_fps or (50.0 if len(rollouts) <= ROW else 25.0)
    runs = pose_rollouts(rollouts, models, max_fps)
    scene = [
        (command, base64.b64encode(three.pack(command)).decode()) for command in build_scene(runs, spacing=spacing)
    ]
    commands = [packed for _, packed in scene]
    title = title or " / ".join(dict.fromkeys(Path(rollout.robot).stem for rollout in rollouts))
    data = _data(runs, plot, ghosts=spacing == 0)
    moving = sum(len(packed) for command, packed in scene if command["type"] == "set_animation")
    sizes = {"movements": moving, "plots": len(data), "meshes, shapes and ground": sum(map(len, commands)) - moving}
    text = filled(
        HERE / "player.html",
        title,
        legend=_legend(runs),
        belts=source("belts.js"),
        plotstyle=source("plots.css"),
        plots=plots_code(),
        player=source("player.js"),
        commands=json.dumps(commands),
        data=data,
        frame=repr(max(rollouts[0].dt, 1.0 / max_fps)),
    )
    return text, {**sizes, "the viewer": len(text) - sum(sizes.values())}


def write_html(rollouts: Rollout | Sequence[Rollout], path: str | Path, **options: Any) -> Path:
    """Write the page of rollouts to a file and return its path; see `page` for the options.

    Warns:
        UserWarning: It is larger than 5 MB; says what takes how much.
    """
    path = Path(path)
    text, sizes = _made(rollouts, **options)
    path.write_text(text, encoding="utf-8")
    if len(text) > LARGE:
        told = ", ".join(f"{name} {size / 1e6:.1f}" for name, size in sorted(sizes.items(), key=lambda one: -one[1]))
        advice = "fewer seconds, robots or frames (max_fps) take less"
        warnings.warn(f"{path}: {len(text) / 1e6:.1f} MB, of which {told}; {advice}", stacklevel=2)
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


def plots_code() -> str:
    """Return the code of plots."""
    return source("graph.js") + source("plots.js")


def source(name: str) -> str:
    """Return the text of a file of the page."""
    return (HERE / name).read_text(encoding="utf-8")


def filled(template: Path, title: str, **values: str) -> str:
    """Return the text of a page: a template with its values and what all pages share.

    Raises:
        ViewerError: meshcat is not installed.
    """
    common = {"title": html.escape(title), "horizon": str(three.hex_color(HORIZON)), "ground": source("ground.js")}
    head = string.Template(source("head.html")).substitute(common)
    text = string.Template(template.read_text(encoding="utf-8"))
    return text.substitute(common | values, head=head, meshcat=meshcat_code())


def _data(runs: Sequence[PosedRollout], plot: Sequence[str], *, ghosts: bool) -> str:
    """Return the plotted data of the first robots as JSON that may stand in a script."""
    shown = list(runs[:ROW])
    found = [charts(run) for run in shown]
    robots = [
        {
            "name": name_of(run),
            "color": css(color_of(index)),
            "ghost": ghosts and index > 0,
            "times": packed(run.times),
            **one.as_json(),
        }
        for index, (run, one) in enumerate(zip(shown, found, strict=True))
    ]
    text = json.dumps({"robots": robots, "chosen": chosen(found, plot)})
    return text.replace("<", "\\u003c")  # a label must not end the script


def name_of(run: PosedRollout) -> str:
    """Return the name of a rollout in the legend."""
    rollout = run.rollout
    return rollout.label or f"{Path(rollout.robot).stem}, {rollout.transmission} transmission"


def color_of(index: int) -> three.Color:
    """Return the colour of a rollout's lines, and of the robot if it is a ghost."""
    return GHOST_TINTS[(index - 1) % len(GHOST_TINTS)] if index else FIRST_COLOR


def _legend(runs: Sequence[PosedRollout]) -> str:
    """Return list items that show and hide what they name: robots, left to right, and kinds of arrows."""
    items = [(color_of(i), name_of(run), [run.path]) for i, run in enumerate(runs[:ROW])]
    if rest := runs[ROW:]:
        items.append((OTHERS_COLOR, f"and {len(rest)} more", [run.path for run in rest]))
    arrows_of = (
        (arrows.FORCE_COLOR, "contact forces", "contact forces", [a for a in runs if a.contact_names]),
        (arrows.COMMAND_COLOR, "commanded speed", "command", [a for a in runs if a.rollout.commands.shape[1] >= 2]),
        (arrows.VELOCITY_COLOR, "actual speed", "velocity", [a for a in runs if a.rollout.commands.shape[1] >= 2]),
    )
    items += [(color, text, [f"{a.path}/{leaf}" for a in who]) for color, text, leaf, who in arrows_of if who]
    return "".join(
        f'<li><label><input type="checkbox" checked data-paths="{html.escape(json.dumps(paths))}">'
        f'<i style="background:{css(color)}"></i>{html.escape(text)}</label></li>'
        for color, text, paths in items
    )


def css(color: three.Color) -> str:
    """Return a colour as style sheets write it."""
    return f"#{three.hex_color(color):06x}"
