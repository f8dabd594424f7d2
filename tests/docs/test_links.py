"""Links lead somewhere, as far as can be told without a network: `make links` follows those that leave.

Links inside the pages that Sphinx builds are checked by its strict build.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from pages import PAGES, ROOT, addresses, anchors, links, name_of, targets

HAND_WRITTEN = [page for page in PAGES if page.parent == ROOT]
CODE = sorted(path for folder in ("ce_gym", "train", "docs/_ext") for path in (ROOT / folder).rglob("*.py"))
TEXTS = [*PAGES, *sorted(ROOT.glob("assets/**/*.md")), ROOT / "CITATION.cff", ROOT / "pyproject.toml"]

BAD = (
    "http://arxiv.org/abs/2311.13732", "https://arxiv.org/abs/231.13732", "https://arxiv", "www.example.org", "https://",
    "https://example.org/a{b}", "https://me:word@example.org/", "https:///path", "https://exa_mple.org",
)  # fmt: skip


def docstrings(file: Path) -> str:
    """Return all docstrings of a Python file; its other strings are no links, such as the names of XML's spaces."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = (node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, kinds))
    return "\n".join(filter(None, map(ast.get_docstring, nodes)))


def is_well_formed(url: str) -> bool:
    """Whether a web address could lead somewhere: over https, to a host with a name, to a paper's own page."""
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        plain = parts.scheme == "https" and parts.netloc == host
    except ValueError:
        return False
    named = re.fullmatch(r"([a-z0-9]([a-z0-9-]*[a-z0-9])?\.)+[a-z]{2,}", host) is not None
    whole = re.fullmatch(r"[\w/.~%=&#?+,:-]*", parts.path + parts.query + parts.fragment, re.ASCII) is not None
    paper = host != "arxiv.org" or re.fullmatch(r"/abs/\d{4}\.\d{4,5}(v\d+)?", parts.path) is not None
    return plain and named and whole and paper


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=name_of)
def test_links_lead_somewhere(page: Path):
    """To files that exist and, where they name one, to a heading in them."""
    broken = [target for target in links(page) if not (page.parent / target).exists()]
    for target in targets(page):
        file, _, anchor = target.partition("#")
        if anchor and not re.match(r"\w+:", target):
            home = page.parent / file if file else page
            broken += [target] if home.is_file() and anchor not in anchors(home) else []
    assert not broken


def test_links_into_the_web_are_well_formed():
    found = {(name_of(path), url) for path in TEXTS for url in addresses(path.read_text(encoding="utf-8"))}
    found |= {(name_of(path), url) for path in CODE for url in addresses(docstrings(path))}
    assert len(found) >= 5, "README and docs link to papers and other projects"
    assert not sorted(one for one in found if not is_well_formed(one[1]))


@pytest.mark.parametrize("url", BAD)
def test_what_is_not_well_formed(url: str):
    """Bad addresses are found in a page and refused."""
    assert not is_well_formed(url)
    assert addresses(f"see [this]({url}).") == [url]


def test_anchors_are_those_of_headings(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("# Your own `robot`, now\n\n```sh\n# no heading\n```\n\n## A\n\n## A\n\n[up](#a-1) [off](#b)\n")
    assert anchors(page) == {"your-own-robot-now", "a", "a-1"}
    assert list(targets(page)) == ["#a-1", "#b"]
