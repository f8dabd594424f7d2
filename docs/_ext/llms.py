"""Sphinx extension: writes `llms.txt`, a list of all pages with a summary of each, for language models.

The format is that of https://llmstxt.org: title, summary, and a list of links in each part of the contents.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment


def setup(app: Sphinx) -> dict[str, Any]:
    """Tell Sphinx when to call us."""
    app.connect("build-finished", write)
    return {"parallel_read_safe": True}


def write(app: Sphinx, error: Exception | None) -> None:
    """Write `llms.txt` beside the front page of a site that has been built without an error."""
    if error is None and app.builder.name == "html":
        (Path(app.outdir) / "llms.txt").write_text(listing(app.env), encoding="utf-8")


def listing(env: BuildEnvironment) -> str:
    """Return the text of `llms.txt`."""
    root = env.config.root_doc
    lines = [f"# {env.config.project}", "", f"> {summary(env, root)}"]
    for toctree in env.get_doctree(root).findall(addnodes.toctree):
        lines += ["", f"## {toctree['caption']}", ""]
        lines += [line for page in toctree["includefiles"] for line in links(env, page)]
    return "\n".join(lines) + "\n"


def links(env: BuildEnvironment, page: str) -> Iterator[str]:
    """Iterate over the lines of a page and of the pages below it."""
    yield f"- [{env.titles[page].astext()}]({env.config.html_baseurl}{page}.html): {summary(env, page)}"
    for below in env.toctree_includes.get(page, []):
        yield from links(env, below)


def summary(env: BuildEnvironment, page: str) -> str:
    """Return the first paragraph of a page in one line."""
    paragraph = next(iter(env.get_doctree(page).findall(nodes.paragraph)), None)
    return " ".join(paragraph.astext().split()) if paragraph else env.titles[page].astext()
