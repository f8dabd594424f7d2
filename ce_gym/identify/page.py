"""A page without scripts: the figures, and what was measured and simulated in windows that were not fitted."""

from __future__ import annotations

import html

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.found import Identified
from ce_gym.identify.overlay import report

Array = NDArray[np.float64]
WIDTH, HEIGHT, LEFT = 900, 150, 70
COLORS = {"measured": "#1f2d3d", "before": "#c9a227", "identified": "#1769aa"}
STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#1f2d3d;max-width:960px;margin:2em auto;padding:0 1em}
pre{background:#f3f5f7;padding:1em;overflow:auto;font-size:13px}svg{width:100%;height:auto}text{font-size:12px;fill:#555}
polyline{fill:none;stroke-width:1.4}b{font-weight:600}"""


def page(found: Identified, shown: int = 4) -> str:
    """Return an HTML page.

    Args:
        found: What was identified.
        shown: How many windows of each measurement are drawn.
    """
    times, *curves = found.curves
    keys = "".join(f' <b style="color:{color}">{name}</b>' for name, color in COLORS.items())
    plots = []
    for k, (kind, name) in enumerate(found.log.measured):
        rms = f"error {1e3 * found.held_out[k]:.3g}, before {1e3 * found.held_out_before[k]:.3g} thousandths"
        plots.append(f"<h3>{html.escape(f'{kind} of {name}')}: {rms}</h3>")
        plots.append(_plot(times[:shown], [curve[:shown, :, k] for curve in curves]))
    title = html.escape(f"{found.robot.name}: identified from {found.log.source}")
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{title}</title><style>{STYLE}</style>"
        f"<h1>{title}</h1><pre>{html.escape(report(found))}</pre><p>Windows that were not fitted:{keys}</p>"
        + "".join(plots)
        + "</html>\n"
    )


def _plot(times: Array, curves: list[Array]) -> str:
    """Return curves over time, shapes (W, L), windows apart from each other."""
    low, high = float(min(c.min() for c in curves)), float(max(c.max() for c in curves))
    span, first, last = max(high - low, 1e-9), float(times.min()), float(times.max())
    lines = []
    for color, curve in zip(COLORS.values(), curves, strict=True):
        for t, y in zip(times, curve, strict=True):
            xs = LEFT + (WIDTH - LEFT - 5) * (t - first) / (last - first)
            ys = 5 + (HEIGHT - 25) * (high - y) / span
            points = " ".join(f"{x:.1f},{v:.1f}" for x, v in zip(xs, ys, strict=True))
            lines.append(f'<polyline points="{points}" stroke="{color}"/>')
    texts = [(0, 15, f"{high:.3f}"), (0, HEIGHT - 22, f"{low:.3f}"), (LEFT, HEIGHT - 4, f"{first:.2f} s")]
    texts.append((WIDTH - 60, HEIGHT - 4, f"{last:.2f} s"))
    words = "".join(f'<text x="{x}" y="{y}">{text}</text>' for x, y, text in texts)
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}">{words}{"".join(lines)}</svg>'
