"""The result of an identification as an HTML page: estimates, and measured and simulated curves of the validation."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.result import Identified
from ce_gym.identify.yaml_output import COLUMNS, remarks, table_rows

Array = NDArray[np.float64]
WIDTH, HEIGHT = 900, 150
MEASURED, BEFORE, AFTER = "#1f2d3d", "#c98a00", "#1769aa"
STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#1f2d3d;max-width:960px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;overflow-wrap:anywhere}h2{font-size:1.1em;margin:2em 0 0}p{margin:.6em 0;overflow-wrap:anywhere}
table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}
td,th{text-align:left;padding:.15em .8em .15em 0}
td:first-child{overflow-wrap:anywhere}tr{border-bottom:1px solid #e3e7eb}
@media(max-width:600px){table{font-size:11px}}
svg{width:100%;height:120px;background:#f6f8f9;display:block}small{color:#555}
polyline{fill:none;stroke-width:1.5;vector-effect:non-scaling-stroke}"""


def page(result: Identified, shown: int = 4) -> str:
    """Return an HTML page without scripts.

    Args:
        result: The result of the identification.
        shown: Number of windows to draw for each measurement.
    """
    plots = [_measurement(result, k, shown) for k in range(len(result.log.measured))]
    title = html.escape(f"{result.robot.name}: identified from {result.log.source}")
    table = "".join(_row("td", row) for row in table_rows(result))
    lines = "".join(f"<p>{html.escape(line)}</p>" for line in remarks(result))
    keys = ", ".join(
        f'<b style="color:{color}">{name}</b>'
        for color, name in ((MEASURED, "measured"), (BEFORE, "errors before"), (AFTER, "errors as identified"))
    )
    return (
        "<!doctype html>\n<!-- ce_gym: measured and simulated curves -->\n"
        '<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
        f"<table>{_row('th', COLUMNS)}{table}</table>{lines}"
        f"<p>Windows that were not fitted, each from its own initial state: {keys}, simulated minus measured.</p>"
        + "".join(plots)
        + "</html>\n"
    )


def _row(cell: str, texts: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{cell}>{html.escape(text)}</{cell}>" for text in texts) + "</tr>"


def _measurement(result: Identified, k: int, shown: int) -> str:
    """Return two plots of a measurement: the curve, and the errors on their own scale."""
    times, measured, before, after = (curve[:shown] for curve in result.curves)
    kind, name = result.log.measured[k]
    rms = f"error {1e3 * result.held_out[k]:.3g}, before {1e3 * result.held_out_before[k]:.3g} thousandths"
    errors = {BEFORE: (before - measured)[..., k], AFTER: (after - measured)[..., k]}
    return (
        f"<h2>{html.escape(f'{kind} of {name}')}: {rms}</h2>"
        + _plot(times, {MEASURED: measured[..., k]})
        + _plot(times, errors)
    )


def _plot(times: Array, curves: dict[str, Array]) -> str:
    """Return a plot of curves over time, by colour, shapes (W, L), with gaps between windows, and a line of ranges."""
    low, high = float(min(c.min() for c in curves.values())), float(max(c.max() for c in curves.values()))
    span, first, last = max(high - low, 1e-9), float(times.min()), float(times.max())
    lines = []
    for color, curve in curves.items():
        for t, y in zip(times, curve, strict=True):
            xs, ys = WIDTH * (t - first) / (last - first), 5 + (HEIGHT - 10) * (high - y) / span
            points = " ".join(f"{x:.1f},{v:.1f}" for x, v in zip(xs, ys, strict=True))
            lines.append(f'<polyline points="{points}" stroke="{color}"/>')
    drawing = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none">{"".join(lines)}</svg>'
    return f"{drawing}<small>{low:.4g} to {high:.4g}, from {first:.2f} to {last:.2f} s</small>"
