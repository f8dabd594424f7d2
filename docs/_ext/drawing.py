"""Small vector drawings for the pages: a robot's cluster tree, lines over an axis. Plain SVG, in the page's colours.

Colours are classes that `_static/ce_gym.css` fills in, so a drawing follows the reader's light or dark theme. Knows
cluster trees and numbers; knows no Sphinx.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from ce_gym.model import Cluster, LinearConstraint, Robot, cluster_tree

ROW, PAD, LETTER = 18, 8, 7.3
"""Height of a line, margin in a box, width of a letter [px]."""
GAP_X, GAP_Y = 14, 34
"""Between boxes [px]."""
SHRINK = 0.72
"""A drawing wider than the page is drawn smaller, down to this; beyond, it scrolls."""


def tree_drawing(robot: Robot) -> str:
    """Return a robot's cluster tree: one box for each cluster, root at the top, one line for each of its bodies."""
    return _Tree(robot).svg()


class _Tree:
    """Places boxes: each subtree is as wide as its children, each box in the middle above them."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.clusters = robot, cluster_tree(robot).clusters
        self.lines = [list(_lines(robot, cluster)) for cluster in self.clusters]
        self.children = {i: [j for j, c in enumerate(self.clusters) if c.parent == i] for i in self._indices}
        self.parts: list[str] = []
        self.height = 0.0

    @property
    def _indices(self) -> list[int | None]:
        return [None, *range(len(self.clusters))]

    def svg(self) -> str:
        """Return the drawing."""
        roots, x = self.children[None], 0.0
        for root in roots:
            self._place(root, x, 2.0)
            x += self._span(root) + GAP_X
        return _svg(x - GAP_X + 2, self.height + 2, self.parts, f"Cluster tree of {self.robot.name}", "ce-tree")

    def _width(self, i: int) -> float:
        return 2 * PAD + 16 + LETTER * max(len(text) for _, text in self.lines[i])

    def _span(self, i: int) -> float:
        below = [self._span(j) for j in self.children[i]]
        return max(self._width(i), sum(below) + GAP_X * (len(below) - 1))

    def _place(self, i: int, x: float, y: float) -> tuple[float, float]:
        """Draw a subtree; return where its box is entered from above."""
        width, tall = self._width(i), 2 * PAD + ROW * len(self.lines[i])
        below = sum(self._span(j) for j in self.children[i]) + GAP_X * (len(self.children[i]) - 1)
        middle, bottom = x + self._span(i) / 2, y + tall
        child = middle - below / 2
        for j in self.children[i]:
            cx, cy = self._place(j, child, bottom + GAP_Y)
            bend = bottom + GAP_Y / 2
            self.parts.append(f'<path class="edge" d="M{middle:.1f} {bottom:.1f}V{bend:.1f}H{cx:.1f}V{cy:.1f}"/>')
            child += self._span(j) + GAP_X
        left = middle - width / 2
        self.parts.append(f'<rect class="box" x="{left:.1f}" y="{y:.1f}" width="{width:.1f}" height="{tall}" rx="6"/>')
        for k, (kind, text) in enumerate(self.lines[i]):
            line = y + PAD + ROW * (k + 0.5)
            if kind != "tie":
                self.parts.append(f'<circle class="{kind}" cx="{left + PAD + 5:.1f}" cy="{line:.1f}" r="4.5"/>')
            self.parts.append(
                f'<text class="{kind}" x="{left + PAD + 16:.1f}" y="{line + 4:.1f}">{escape(text)}</text>'
            )
        self.height = max(self.height, bottom)
        return middle, y


def _lines(robot: Robot, cluster: Cluster):
    """Iterate over the lines of a box: kind and text of each body, then the ties that are not gears."""
    gears = {c.bodies[0]: c for c in cluster.constraints if isinstance(c, LinearConstraint)}
    for name in cluster.bodies:
        body = robot.body(name)
        kind = "rotor" if body.kind == "rotor" else "free" if name in cluster.independent or _free(body) else "tied"
        ratios = [-a / gears[name].coefficients[0][1] for _, a in gears[name].coefficients[1:]] if name in gears else []
        yield kind, name + "".join(f"  ×{ratio:.4g}" for ratio in ratios)
    for tie in cluster.constraints:
        if not isinstance(tie, LinearConstraint):
            yield "tie", f"{type(tie).__name__.removesuffix('Constraint').lower()}: {tie.name}"


def _free(body) -> bool:
    return body.joint.type == "free"


def line_chart(x: Sequence[float], lines: Mapping[str, Sequence[float]], x_label: str, y_label: str) -> str:
    """Return a chart of lines over a common axis.

    Args:
        x: Values along the axis.
        lines: Values of each line by its name, each as many as `x`.
        x_label: Quantity and unit along the axis.
        y_label: Quantity and unit of the lines.
    """
    width, height, left, right, top, bottom = 720, 300, 56, 96, 12, 40
    low, high = min(min(y) for y in lines.values()), max(max(y) for y in lines.values())
    step = _round_step(high - low)
    low, high = step * (low // step), step * -(-high // step)

    def at(a: float, b: float) -> tuple[float, float]:
        return (
            left + (a - x[0]) / (x[-1] - x[0]) * (width - left - right),
            top + (high - b) / (high - low) * (height - top - bottom),
        )

    parts = []
    for k in range(round((high - low) / step) + 1):
        (_, y), value = at(x[0], low + k * step), low + k * step
        parts.append(f'<path class="grid" d="M{left} {y:.1f}H{width - right}"/>')
        parts.append(f'<text class="tick" x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.4g}</text>')
    along = _round_step(x[-1] - x[0])
    for k in range(int((x[-1] - x[0]) / along + 1e-9) + 1):
        place, _ = at(x[0] + k * along, low)
        text = f"{x[0] + k * along:.4g}"
        parts.append(
            f'<text class="tick" x="{place:.1f}" y="{height - bottom + 16}" text-anchor="middle">{text}</text>'
        )
    for k, (name, values) in enumerate(lines.items()):
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in map(at, x, values))
        parts.append(f'<polyline class="line s{k}" points="{points}"/>')
        y = top + 16 + 20 * k
        parts.append(f'<path class="line s{k}" d="M{width - right + 10} {y}h18"/>')
        parts.append(f'<text class="name" x="{width - right + 34}" y="{y + 4}">{escape(name)}</text>')
    below, beside = f'x="{(left + width - right) / 2}" y="{height - 6}"', (top + height - bottom) / 2
    turned = f'transform="translate(13 {beside}) rotate(-90)"'
    for place, label in ((below, x_label), (turned, y_label)):
        parts.append(f'<text class="tick" {place} text-anchor="middle">{escape(label)}</text>')
    return _svg(width, height, parts, f"{y_label} over {x_label}", "ce-chart")


def _round_step(span: float) -> float:
    """Return 1, 2 or 5 times a power of ten that divides a span into four to ten parts."""
    for exponent in range(-9, 9):
        for mantissa in (1, 2, 5):
            if span / (mantissa * 10.0**exponent) <= 8:
                return mantissa * 10.0**exponent
    return span


def _svg(width: float, height: float, parts: Sequence[str], title: str, kind: str) -> str:
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" style="max-width:{width:.0f}px;min-width:{SHRINK * width:.0f}px"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" role="img" {size}><title>{escape(title)}</title>'
    return f'<div class="{kind}">{head}{"".join(parts)}</svg></div>'
