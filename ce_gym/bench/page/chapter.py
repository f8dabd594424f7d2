"""What the page says of one benchmark, in Markdown and in HTML: its command, bars, met or missed alike, tables."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ce_gym.bench.measure.report import Report, Table, cell_text
from ce_gym.model.table import Cell

STYLE = """body{font:16px/1.5 system-ui,sans-serif;color:#1f2d3d;background:#fff;max-width:1040px}
body{margin:2em auto;padding:0 1em}
h1{font-size:1.6em}h2{font-size:1.25em;margin:2.5em 0 .5em;border-top:1px solid #c9d1d9;padding-top:1em}
h3{font-size:1em;margin:1.5em 0 .4em}p,li,code{overflow-wrap:anywhere}code{background:#f1f4f6;padding:.1em .3em}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.1em 1em;font-size:14px}dd{margin:0}dt{color:#57636e}
ul{list-style:none;padding:0}li{margin:.25em 0}b.met{color:#1a7f37}b.missed{color:#b42318}
div{overflow-x:auto}table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
td,th{text-align:left;padding:.2em .9em .2em 0;vertical-align:top}td.n,th.n{text-align:right}td.n{white-space:nowrap}
td:first-child{min-width:7em}th{vertical-align:bottom}
tr{border-bottom:1px solid #e3e7eb}th{border-bottom:2px solid #c9d1d9}img{max-width:100%}a{color:#1769aa}
@media(max-width:600px){body{font-size:15px}table,dl{font-size:12px}td,th{padding-right:.6em}}"""


@dataclass(frozen=True)
class Chapter:
    """One benchmark of the page.

    Attributes:
        command: Its arguments after `python -m ce_gym.bench`.
        said: Why there is nothing to show, if so.
        found: Its report.
        folder: Its files, beside the page.
    """

    command: str
    said: str
    found: Report
    folder: Path

    @property
    def pictures(self) -> list[str]:
        """Files relative to the page."""
        return [f"{self.folder.name}/{file.name}" for file in sorted(self.folder.glob("*.png"))]

    def as_markdown(self) -> str:
        """Return the chapter in Markdown."""
        found = self.found
        bars = [
            f"- {'**missed**' if bar.met is False else bar.verdict}: {bar.claim}: {bar.measured}"
            for bar in found.requirements
        ]
        parts = [f"## {found.name}", f"`python -m ce_gym.bench {self.command}`", self.said, "\n".join(bars)]
        parts += [f"![]({picture})" for picture in self.pictures]
        parts += [table.as_markdown() for table in found.tables] + found.remarks
        return "\n\n".join(part for part in parts if part) + "\n"

    def as_html(self) -> str:
        """Return the chapter in HTML; every table has a link to its CSV."""
        found, escape = self.found, html.escape
        bars = "".join(
            f'<li><b class="{word}">{word}</b> {escape(bar.claim)}: {escape(bar.measured)}</li>'
            for bar in found.requirements
            for word in (bar.verdict.lower(),)
        )
        parts = [f'<h2 id="{escape(found.name)}">{escape(found.name)}</h2>']
        parts += [f"<p><code>python -m ce_gym.bench {escape(self.command)}</code></p>"]
        parts += [f"<p>{escape(self.said)}</p>"] * bool(self.said) + [f"<ul>{bars}</ul>"] * bool(bars)
        parts += [f'<p><img src="{escape(picture)}" alt=""></p>' for picture in self.pictures]
        for i, table in enumerate(found.tables, start=1):
            file = f'<a href="{escape(self.folder.name)}_{i}.csv">CSV</a>'
            parts += [f"<h3>{escape(table.title)} ({file})</h3>", table_html(table)]
        return "".join([*parts, *(f"<p>{escape(remark)}</p>" for remark in found.remarks)])


def page_html(title: str, machine: Mapping[str, str], summary: Table, chapters: Sequence[Chapter]) -> str:
    """Return the whole page: machine and versions, how many bars each benchmark met, and the chapters."""
    facts = "".join(f"<dt>{html.escape(key)}</dt><dd>{html.escape(value)}</dd>" for key, value in machine.items())
    names = [chapter.found.name for chapter in chapters]
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    return (
        f"{head}<title>{html.escape(title)}</title><style>{STYLE}</style><h1>{html.escape(title)}</h1>"
        f"<dl>{facts}</dl>{table_html(summary, links=names)}{''.join(c.as_html() for c in chapters)}</html>\n"
    )


def table_html(table: Table, links: Sequence[str] = ()) -> str:
    """Return a table, numbers to the right; cells that say one of `links` lead to the chapter of that name."""
    numbers = [all(_is_number(row[i]) for row in table.rows) and bool(table.rows) for i in range(len(table.columns))]
    rows = [_row("th", table.columns, numbers, ())]
    rows += [_row("td", row, numbers, links) for row in table.rows]
    return f"<div><table>{''.join(rows)}</table></div>"


def _row(tag: str, cells: Sequence[Cell], numbers: Sequence[bool], links: Sequence[str]) -> str:
    texts = []
    for cell, right in zip(cells, numbers, strict=True):
        text = html.escape(cell_text(cell))
        text = f'<a href="#{text}">{text}</a>' if cell in links else text
        texts.append(f"<{tag}{' class=n' if right else ''}>{text}</{tag}>")
    return f"<tr>{''.join(texts)}</tr>"


def _is_number(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, int | float) and not isinstance(cell, bool))
