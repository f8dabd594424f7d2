"""Writes rollouts as one self-contained HTML file, which needs neither server nor network."""

from __future__ import annotations

import base64
import contextlib
import html
import importlib.util
import json
import string
import threading
import warnings
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ce_gym.files import PAGE, write_file
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page import arrows, three
from ce_gym.viewer.page.charts import charts, default_plots, packed
from ce_gym.viewer.page.lights_and_camera import HORIZON
from ce_gym.viewer.page.poses import PosedRollout
from ce_gym.viewer.page.scene import GHOST_TINTS, ROW, build_scene, pose_rollouts
from ce_gym.viewer.rollouts.rollout import Rollout
from ce_gym.viewer.server import PageServer

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

WEB = Path(__file__).parents[1] / "web"
FIRST_COLOR = (0.15, 0.20, 0.27)
OTHERS_COLOR = (0.62, 0.66, 0.70)
LARGE = 5_000_000
"""Size of a page beyond which `write_html` warns [bytes]."""


def page(
    rollouts: Rollout | Sequence[Rollout],
    *,
    title: str | None = None,
    models: Sequence[Model] | None = None,
    spacing: float | None = None,
    plot: Sequence[str] = (),
    max_fps: float | None = None,
) -> str:
    """Return a self-contained HTML page that plays rollouts, with plots beside the robots.

    Args:
        rollouts: Several robots stand side by side, many in a square.
        title: Heading of the page; by default the robots' names.
        models: The `Model` of each rollout; built from the rollouts if not given.
        spacing: Distance between neighbours [m]; 0 draws all but the first as ghosts in the same place. By default
            neighbours do not overlap.
        plot: Names, or beginnings of names, of the signals to plot first. The page can plot all other signals.
        max_fps: Frames beyond this rate are left out [1/s]; by default 50, and 25 for more than four robots.

    Raises:
        ViewerError: meshcat is not installed, a rollout does not fit its robot, or a signal of `plot` is unknown.
    """
    rollouts = [rollouts] if isinstance(rollouts, Rollout) else list(rollouts)
    meshcat_code()  # a missing meshcat is reported before the computation
    max_fps = max_fps or (50.0 if len(rollouts) <= ROW else 25.0)
    runs = pose_rollouts(rollouts, models, max_fps)
    return filled(
        "player",
        title or " / ".join(dict.fromkeys(Path(rollout.robot).stem for rollout in rollouts)),
        scripts=("belts", "overlays", "graph", "plots", "player"),
        constants={
            "COMMANDS": packed_commands(build_scene(runs, spacing=spacing)),
            "DATA": _data(runs, plot, ghosts=spacing == 0),
            "FRAME": max(rollouts[0].dt, 1.0 / max_fps),
        },
        legend=_legend(runs),
    )


def write_html(rollouts: Rollout | Sequence[Rollout], path: str | Path, **options: Any) -> Path:
    """Write the page of rollouts to a file and return its path; see `page` for the options.

    Warns:
        UserWarning: The page is larger than 5 MB.
    """
    path = Path(path)
    text = page(rollouts, **options)
    write_file(path, text, PAGE)
    if len(text) > LARGE:
        advice = "fewer seconds, robots or frames (max_fps) make it smaller"
        warnings.warn(f"{path}: the page has {len(text) / 1e6:.1f} MB; {advice}", stacklevel=2)
    return path


def show(
    rollouts: Rollout | Sequence[Rollout], *, open_browser: bool = False, seconds: float | None = None, **options: Any
) -> None:
    """Play rollouts in browsers on this machine, in real time and in a loop, until Ctrl-C.

    Args:
        rollouts: Several robots stand side by side.
        open_browser: Open a browser at the page.
        seconds: Stop after this time [s].
        options: Title, models, spacing and frame rate; see `page`.

    Raises:
        ViewerError: meshcat is not installed, or a rollout does not fit its robot.
    """
    with contextlib.closing(PageServer(page(rollouts, **options))) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"playing at {server.url} (Ctrl-C to stop)", flush=True)
        if open_browser:
            webbrowser.open(server.url, new=2)
        threading.Event().wait(seconds)


def meshcat_code() -> str:
    """Return the code of meshcat's page.

    Raises:
        ViewerError: meshcat is not installed.
    """
    spec = importlib.util.find_spec("meshcat")
    if spec is None or spec.origin is None:
        raise ViewerError.missing("meshcat")
    return Path(spec.origin).with_name("viewer").joinpath("dist", "main.min.js").read_text(encoding="utf-8")


def packed_commands(commands: Sequence[three.Command]) -> list[str]:
    """Return commands as base64 of the bytes that meshcat's page reads."""
    return [base64.b64encode(three.pack(command)).decode() for command in commands]


def filled(name: str, title: str, *, scripts: Sequence[str], constants: Mapping[str, Any], **values: str) -> str:
    """Return the page `web/<name>.html` with its scripts.

    Args:
        name: Name of the template.
        title: Title of the page.
        scripts: Names of scripts in `web/`, in order; the scene's own come before them.
        constants: Values that the scripts use, by name, as JSON.
        values: Further placeholders of the template.

    Raises:
        ViewerError: meshcat is not installed.
    """
    constants = {"HORIZON": three.hex_color(HORIZON), **constants}
    # Without "<" no text can end its script.
    lines = [f"const {key} = {json.dumps(value)};\n".replace("<", "\\u003c") for key, value in constants.items()]
    codes = [meshcat_code(), "".join(lines), *(_source(f"{script}.js") for script in ("ground", "scene", *scripts))]
    return _substituted(name, title, scripts="\n".join(f"<script>\n{code}</script>" for code in codes), **values)


def waiting_page(title: str) -> str:
    """Return the page that is shown until a live page is ready."""
    return _substituted("waiting", title)


def _substituted(name: str, title: str, **values: str) -> str:
    common = {"title": html.escape(title), "plotstyle": _source("plots.css")}
    head = string.Template(_source("head.html")).substitute(common)
    return string.Template(_source(f"{name}.html")).substitute(common | values, head=head)


def _source(name: str) -> str:
    return (WEB / name).read_text(encoding="utf-8")


def _data(runs: Sequence[PosedRollout], plot: Sequence[str], *, ghosts: bool) -> dict[str, Any]:
    """Return the plotted signals of the first robots for `player.js`."""
    plotted = runs[:ROW]
    all_charts = [charts(run) for run in plotted]
    robots = [
        {
            "name": name_of(run),
            "color": css(color_of(index)),
            "ghost": ghosts and index > 0,
            "times": packed(run.times),
            **chart.as_json(),
        }
        for index, (run, chart) in enumerate(zip(plotted, all_charts, strict=True))
    ]
    return {"robots": robots, "chosen": default_plots(all_charts, plot)}


def name_of(run: PosedRollout) -> str:
    """Return the name of a rollout in the legend."""
    rollout = run.rollout
    return rollout.label or f"{Path(rollout.robot).stem}, {rollout.transmission} transmission"


def color_of(index: int) -> three.Color:
    """Return the colour of a rollout's curves; a ghost has the same colour."""
    return GHOST_TINTS[(index - 1) % len(GHOST_TINTS)] if index else FIRST_COLOR


def _legend(runs: Sequence[PosedRollout]) -> str:
    """Return list items with boxes that show and hide robots, left to right, and kinds of arrows."""
    items = [(color_of(i), name_of(run), [run.path]) for i, run in enumerate(runs[:ROW])]
    if rest := runs[ROW:]:
        items.append((OTHERS_COLOR, f"and {len(rest)} more", [run.path for run in rest]))
    in_contact = [run for run in runs if run.contact_names]
    commanded = [run for run in runs if run.rollout.commands.shape[1] >= 2]
    for color, text, leaf, group in (
        (arrows.FORCE_COLOR, "contact forces", "contact forces", in_contact),
        (arrows.COMMAND_COLOR, "commanded speed", "command", commanded),
        (arrows.VELOCITY_COLOR, "actual speed", "velocity", commanded),
    ):
        if group:
            items.append((color, text, [f"{run.path}/{leaf}" for run in group]))
    return "".join(
        f'<li><label><input type="checkbox" checked data-paths="{html.escape(json.dumps(paths))}">'
        f'<i style="background:{css(color)}"></i>{html.escape(text)}</label></li>'
        for color, text, paths in items
    )


def css(color: three.Color) -> str:
    """Return a colour in the notation of style sheets."""
    return f"#{three.hex_color(color):06x}"
