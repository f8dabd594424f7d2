"""Tables of the reference: terms, the context that terms read, tasks, training settings, commands, policies, results.

Each function returns Markdown that a page includes. Everything comes from docstrings, parsers, settings files, cards of
policies and results of benchmarks, so that a page cannot say what the code does not.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator
from dataclasses import MISSING
from functools import cached_property
from pathlib import Path
from typing import Any

from environment_page import attributes_of, plain, table, task_fields

from ce_gym.__main__ import _parser
from ce_gym.bench.measure.report import Report, cell_text, read_report
from ce_gym.dynamics.laws.scene_laws import OUTPUTS, PARAMETERS
from ce_gym.dynamics.parameters import RANGES
from ce_gym.envs.task.tasks import RANDOMISED
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.registry import OWN
from ce_gym.learn.runs.settings import load_settings
from ce_gym.learn.training import learner

ROOT = Path(__file__).parents[2]
KINDS = {"reward": "Rewards", "observation": "Observations", "termination": "Terminations", "metric": "Metrics"}

UNIT = re.compile(r" ?\[(?!-?\d)([^\]]+)\]")
"""A unit in brackets; a range such as [-1, 1] is none."""
SHAPE = re.compile(r",? ?(?:shape )?(\((?:[^()]|\([^()]*\))*,[^()]*\)(?: or \([^()]*\))?)(?: each)?")
"""A shape such as (3,), (n,) or (0,)."""


def terms() -> str:
    """Return one table for each kind of term: name, parameters with defaults, meaning, unit."""
    parts = []
    for kind, heading in KINDS.items():
        rows = [(f"`{name}`", _parameters(f), *_meaning_and_unit(f)) for name, f in sorted(OWN[kind].items())]
        parts.append(f"## {heading}\n\n{table(('Term', 'Parameters', 'Meaning', 'Unit'), rows)}")
    return "\n\n".join(parts) + "\n"


def context() -> str:
    """Return the table of what a term can read from its `TermContext`: name, shape, unit, meaning."""
    rows = []
    for name, member in sorted(vars(TermContext).items()):
        if name.startswith("_") or not isinstance(member, property | cached_property):
            continue
        text = " ".join((inspect.getdoc(member) or "").split("\n\n")[0].split())
        text, unit = _split_unit(text)
        found = SHAPE.search(text)
        shape = found[1] if found else "scalar"
        getter: Any = member.fget if isinstance(member, property) else member.func
        if str(getter.__annotations__.get("return", "")).startswith("list"):
            shape = f"list, {shape} each"
        rows.append((f"`s.{name}`", shape, unit, SHAPE.sub("", text, count=1)))
    functions = [f for name, f in vars(TermContext).items() if inspect.isfunction(f) and not name.startswith("_")]
    methods = [(f"`s.{f.__name__}({_call(f)})`", _first_line(f)) for f in functions]
    columns = ("Name", "Shape", "Unit", "Meaning")
    return f"{table(columns, rows)}\n\n{table(('Method', 'Meaning'), methods)}\n"


def task_arguments() -> str:
    """Return the table of a task's arguments with defaults, and the table of figures that can be randomised."""
    rows = []
    for field, meaning in task_fields():
        if field.default is not MISSING:
            default = f"`{plain(field.default)}`"
        elif field.default_factory is not MISSING:
            default = f"`{plain(field.default_factory())}`"
        else:
            default = "of the task"
        rows.append((f"`{field.name}`", default, meaning))
    drawn = []
    for name, text in RANDOMISED.items():
        unit = re.search(r"\[([^\]]+)\]", text)
        drawn.append((f"`{name}`", unit[1] if unit else "-", re.sub(r" ?\[[^\]]+\]", "", text)))
    parameters = table(("Name", "Unit", "Meaning"), drawn)
    return f"{table(('Argument', 'Default', 'Meaning'), rows)}\n\n## Randomised parameters\n\n{parameters}\n"


def parameters() -> str:
    """Return the table of parameters that can differ from robot to robot."""
    rows = [(f"`{p.name}`", p.meaning, p.unit, f"`{p.size}`", RANGES[p.allowed].expected) for p in PARAMETERS.values()]
    return table(("Parameter", "Meaning", "Unit", "Size", "Allowed values"), rows) + "\n"


def outputs() -> str:
    """Return the table of outputs of a step."""
    moments = {"start": "start of the step", "end": "end of the step", "mean": "mean over the step"}
    rows = [(f"`{o.name}`", o.meaning, o.unit, moments[o.of]) for o in OUTPUTS.values()]
    return table(("Output", "Meaning", "Unit", "Moment"), rows) + "\n"


def settings() -> str:
    """Return a table of settings for each learner: name, default, unit, meaning."""
    parts = []
    for title, algo in (("PPO", "ppo"), ("SHAC", "shac"), ("Distillation", "distill")):
        kind = learner(algo).Settings
        values = load_settings(kind.folder / "default.yaml", (), kind).as_dict()
        texts = [attributes_of(inspect.cleandoc(base.__doc__ or "")) for base in reversed(kind.__mro__)]
        meanings = {name: text for each in texts for name, text in each.items()}
        rows = [(f"`{name}`", f"`{plain(value)}`", *_split_unit(meanings[name])) for name, value in values.items()]
        parts.append(f"## {title}\n\n{table(('Setting', 'Default', 'Meaning', 'Unit'), rows)}")
    return "\n\n".join(parts) + "\n"


def command_line() -> str:
    """Return a section with a table of options for each subcommand of `python -m ce_gym`."""
    parts = []
    for name, parser in _subcommands(_parser()):
        rows = [
            (_invocation(action), _default(action), (action.help or "").replace("<", "&lt;"))
            for action in parser._actions
        ]
        rows = [row for row in rows if row[0] != "`-h`, `--help`"]
        described = " ".join((parser.description or "").split())
        usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
        parts.append(f"## {name}\n\n{described}\n\n```text\n{usage}\n```\n")
        parts.append(table(("Argument", "Default", "Meaning"), rows) + "\n" if rows else "")
    return "\n".join(part for part in parts if part)


def policies() -> str:
    """Return the table of trained policies, from their cards: figures and falls on each level."""
    rows, levels = [], ("exact", "armature", "none")
    for card in sorted((ROOT / "assets" / "policies").glob("*/card.md")):
        text, name = card.read_text(encoding="utf-8"), card.parent.name
        level = name.rsplit("_", 1)[1]
        facts = {row[0]: row[1] for row in _rows(text, "environment") if len(row) == 2}
        judged = {row[0].split("`")[1]: row for row in _rows(text, f"`{level}` (trained)") if "`," not in row[0]}
        heads = _rows(text, f"`{level}` (trained)", head=True)[0]
        first, fallen = heads[1], heads.index("falls")
        falls = [judged[one][fallen] if one in judged else "" for one in levels]
        steps = facts["steps"].replace(",", "")
        rows.append((f"`{name}`", f"{int(steps) / 1e6:.1f}", f"{judged[level][1]} ({_unit_free(first)})", *falls))
    columns = ("Policy", "Million steps", "First figure of its card", *(f"Falls on `{level}`" for level in levels))
    return table(columns, rows) + "\n"


def results() -> dict[str, str]:
    """Return for each benchmark with a results file its tables, each with command, processor and date, by name."""
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    return {file.stem: _report_text(read_report(file)) for file in files}


def _report_text(report: Report) -> str:
    parts = []
    for part in report.tables:
        rows = [[cell_text(cell) for cell in row] for row in part.rows]
        parts.append(f"{part.title}:\n\n{table(part.columns, map(tuple, rows))}")
    machine = report.machine
    parts.append(f"`{report.command}`, {machine['processor']}, {machine['cores']} cores, {machine['date']}.")
    return "\n\n".join(parts) + "\n"


def _call(function: Any) -> str:
    """Return the arguments of a method as in a call, without `self` and without types."""
    given = list(inspect.signature(function).parameters.values())[1:]
    return ", ".join(p.name if p.default is p.empty else f"{p.name}={p.default!r}" for p in given)


def _parameters(function: Any) -> str:
    given = list(inspect.signature(function).parameters.values())[1:]
    return ", ".join(f"`{p.name}={p.default!r}`" for p in given if p.default is not p.empty) or "-"


def _first_line(function: Any) -> str:
    return " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())


def _meaning_and_unit(function: Any) -> tuple[str, str]:
    return _split_unit(_first_line(function))


def _split_unit(text: str) -> tuple[str, str]:
    """Return a text without its units in brackets, and the units, "-" if there are none."""
    units = UNIT.findall(text)
    return UNIT.sub("", text), ", ".join(dict.fromkeys(units)) or "-"


def _subcommands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


def _invocation(action: argparse.Action) -> str:
    names = action.option_strings or [str(action.metavar or action.dest)]
    return ", ".join(f"`{name}`" for name in names)


def _default(action: argparse.Action) -> str:
    unset = action.default in (None, False, "", float("inf"), argparse.SUPPRESS, [], ())
    several = isinstance(action.default, list | tuple)
    shown = " ".join(map(str, action.default)) if several else action.default
    return "" if unset or not action.option_strings else f"`{shown}`"


def _rows(text: str, first: str, head: bool = False) -> list[list[str]]:
    """Return the rows of the Markdown table in which a row begins with a text; only its head if so wished."""
    for block in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
        if any(row[0] == first for row in rows):
            return rows[:1] if head else rows[2:]
    raise ValueError(f"no table with a row {first!r}")


def _unit_free(heading: str) -> str:
    return f"{heading} error" if heading.startswith("forward [") else heading
