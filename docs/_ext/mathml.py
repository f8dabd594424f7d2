"""Sphinx extension: formulas as MathML, which browsers set by themselves: no script, no fonts, no network.

docutils translates the LaTeX; a formula that it does not understand is a warning, and so an error of the build.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

LOGGER = logging.getLogger(__name__)
MATHML, DOTS = "http://www.w3.org/1998/Math/MathML", "˙¨"


def setup(app: Sphinx) -> dict[str, Any]:
    """Tell Sphinx of the renderer."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))  # type: ignore[arg-type]
    return {"parallel_read_safe": True}


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="ce-math">{_mathml(node, as_block=True)}</div>')
    raise nodes.SkipNode


def _mathml(node: nodes.Element, as_block: bool) -> str:
    try:
        return _indexed(tex2mathml(node.astext(), as_block=as_block))
    except MathError as error:
        LOGGER.warning("formula %s: %s", node.astext(), error, location=node)
        return ""


def _indexed(text: str) -> str:
    """Put the index of a dotted letter beside it; docutils puts it below, where the dot is above."""
    ElementTree.register_namespace("", MATHML)
    formula = ElementTree.fromstring(text.replace("&ApplyFunction;", "\u2061"))
    for element in formula.iter(f"{{{MATHML}}}munderover"):
        base, index, dot = element
        if dot.text in DOTS:
            dotted = ElementTree.Element(f"{{{MATHML}}}mover", accent="true")
            dotted.extend([base, dot])
            element[:] = [dotted, index]
            element.tag = f"{{{MATHML}}}msub"
    return ElementTree.tostring(formula, encoding="unicode")
