"""The pages in pieces: code blocks by language, commands, links. Knows the Markdown that we use."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
HIDDEN = {"generated", "records", "_build"}
"""Folders of `docs` without pages of the manual."""
DOCS = [page for page in (ROOT / "docs").rglob("*.md") if not HIDDEN & set(page.relative_to(ROOT).parts)]
PAGES = sorted([*ROOT.glob("*.md"), *DOCS])
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"(?:# |<!-- )([\w-]+\.(?:yaml|urdf|xml|py))(?: -->)?\n")


@dataclass(frozen=True)
class Block:
    """A code block.

    Attributes:
        language: What stands behind the backticks.
        text: The code.
        line: Where it begins in its page, from 0.
    """

    language: str
    text: str
    line: int

    @property
    def file(self) -> str | None:
        """Name of the file that it is, if its first line is a comment that says so."""
        found = NAMED.match(self.text)
        return found[1] if found else None


def name_of(page: Path) -> str:
    """Return a page's path in the repository."""
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[Block]:
    """Iterate over the code blocks of a page."""
    text = page.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        yield Block(found[1], found[2], text[: found.start(2)].count("\n"))


def script(page: Path) -> str:
    """Return a page as one script: its Python, each line where it is in the page, so that errors name that line.

    A block that is a file is written when its turn has come.
    """
    lines = [""] * page.read_text(encoding="utf-8").count("\n")
    for block in blocks(page):
        if block.file:
            lines[block.line] = f"__import__('pathlib').Path({block.file!r}).write_text({block.text!r})"
        elif block.language == "python":
            code = block.text.splitlines()
            lines[block.line : block.line + len(code)] = code
    return "\n".join(lines) + "\n"


def commands(page: Path) -> Iterator[str]:
    """Iterate over the commands of a page: lines of its shell blocks, and inline code that begins like one."""
    text = page.read_text(encoding="utf-8")
    for block in blocks(page):
        if block.language == "sh":
            yield from (line for line in block.text.replace("\\\n", " ").splitlines() if line.strip())
    prose = BLOCK.sub("", text)
    yield from (" ".join(code.split()) for code in re.findall(r"`((?:python|make|pip|cp) [^`]+)`", prose))


def targets(page: Path) -> Iterator[str]:
    """Iterate over what links and pictures of a page lead to."""
    yield from re.findall(r"\]\(([^)\s]+)\)", BLOCK.sub("", page.read_text(encoding="utf-8")))


def links(page: Path) -> Iterator[str]:
    """Iterate over the targets of links and pictures that stay in the repository, without their anchors."""
    for target in targets(page):
        if not re.match(r"[a-z]+:", target) and not target.startswith("#"):
            yield target.split("#")[0]


def anchors(page: Path) -> set[str]:
    """Return what can stand behind `#` in a link to a page: its headings, as GitHub and MyST shorten them."""
    found: dict[str, int] = {}
    for title in re.findall(r"^#+ (.+)$", BLOCK.sub("", page.read_text(encoding="utf-8")), re.MULTILINE):
        name = re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")
        found[name] = found.get(name, -1) + 1
    return set(found) | {f"{name}-{i}" for name, last in found.items() for i in range(1, last + 1)}


def addresses(text: str) -> list[str]:
    """Return the web addresses in a text, and malformed ones."""
    return [found.rstrip(".,;:") for found in re.findall(r"(?:\b(?!file:)\w+://|\bwww\.)[^\s<>\"'`)\]]*", text)]
