"""What figures of a benchmark depend on: the functions, classes and constants that it reaches, and its robots' files.

From the benchmark's own module on, whatever a definition names is followed to where it is defined. Two versions of it
are equal if they do the same: comments, docstrings, annotations and texts of errors do not count. So a figure is stale
when what it was measured with does something else, not when it reads better, and not for what it never runs. What is
found by a name put together at run time is not followed. Versions of other packages and the machine do not count.
"""

from __future__ import annotations

import ast
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import yaml

from ce_gym.bench.page.source import Source, uses

ROOT = Path(__file__).resolve().parents[3]
SHOWN = ("ce_gym/viewer/", "ce_gym/bench/measure/machine.py", "ce_gym/bench/measure/report.py")
"""What shows figures and has no part in them; so have modules of the name `plots`."""
Need = tuple[str, str]
"""A file, and a name in it; "*" for all of it, "" for what runs when it is imported."""


def benchmark_file(name: str) -> str:
    """Return the file of a benchmark: a module of `bench`, the module `benchmark` of a package, or a module in one."""
    bench = ROOT / "ce_gym" / "bench"
    candidates = (bench / f"{name}.py", bench / name / "benchmark.py", *bench.glob(f"*/{name}.py"))
    return next(path for path in candidates if path.exists()).relative_to(ROOT).as_posix()


@cache
def needed(script: str) -> frozenset[Need]:
    """Return everything that a module or script depends on, itself included.

    Args:
        script: Its file, relative to the repository.
    """
    found, left = set[Need](), {(script, "*")}
    while left:
        need = left.pop()
        if need not in found and not need[0].startswith(SHOWN) and not need[0].endswith("/plots.py"):
            found.add(need)
            left |= {(need[0], ""), *_follow(*need)} - found
    return frozenset(found)


def changed(script: str, commit: str) -> list[str]:
    """Return the files in which something that a script depends on does something else than at a commit, sorted.

    Raises:
        LookupError: This is no repository that knows the commit.
    """
    needs = needed(script)
    files = {file for file, _ in needs} | set(_robot_files(script, needs))
    different = _git("diff", "--name-only", commit, "--", *sorted(files)).splitlines()
    return [file for file in different if not _same(file, {name for f, name in needs if f == file}, commit)]


def _same(file: str, names: set[str], commit: str) -> bool:
    """Whether names of a file mean what they meant at a commit; in a file that was not there they do not."""
    try:
        then = _git("show", f"{commit}:{file}")
    except LookupError:
        return False
    now = (ROOT / file).read_text(encoding="utf-8") if (ROOT / file).exists() else ""
    if file.endswith(".py"):
        old, new = Source.of(then), Source.of(now)
        return all(old.meaning(name) == new.meaning(name) for name in names)
    if file.endswith(".yaml"):
        return yaml.safe_load(then) == yaml.safe_load(now)
    before, after = (ElementTree.canonicalize(text or "<none/>", strip_text=True) for text in (then, now))
    return before == after


def _follow(file: str, name: str) -> Iterator[Need]:
    """Yield what a name of a file depends on."""
    source = _source(file)
    for used, attribute in uses(source.statements(name)):
        if used in source.names:
            yield file, used
        elif used in source.imports:
            yield from _target(*source.imports[used], attribute, file)
    package = file.endswith("__init__.py")
    for alias in source.imports if name == "*" else () if package else source.idle:
        yield from _target(*source.imports[alias], "" if name != "*" or alias in source.idle else "?", file)


def _target(module: str, name: str, attribute: str, by: str) -> Iterator[Need]:
    """Yield where a name of a module is defined, or what is asked of the module that it is; "?" for nothing."""
    inner, outer = _file(f"{module}.{name}" if name else module, by), _file(module, by)
    if inner and attribute != "?":
        yield from _find(inner, attribute) if attribute else [(inner, "*")]
    elif outer and not inner:
        yield from _find(outer, name)


def _find(file: str, name: str) -> Iterator[Need]:
    """Yield where a name that a file has is defined."""
    source = _source(file)
    if name in source.names:
        yield file, name
    elif name in source.imports:
        yield from _target(*source.imports[name], "", file)
    else:
        folder = file.removesuffix("/__init__.py")
        yield (_file(f"{folder}/{name}".replace("/", "."), "") or file), "*"


def _file(module: str, by: str) -> str:
    """Return the file of a module of the repository, imported by a file of it; nothing for others."""
    path = module.replace(".", "/")
    for start in (Path(), *([] if by.startswith("ce_gym/") else [Path(by).parent])):  # scripts find their neighbours
        for end in (f"{path}.py", f"{path}/__init__.py"):
            if (ROOT / start / end).exists():
                return (start / end).as_posix()
    return ""


def _robot_files(script: str, needs: frozenset[Need]) -> Iterator[str]:
    """Yield the files of the robots that a benchmark names, or environments of; of all if it asks which there are."""
    benches = [need for need in needs if need[0].startswith(("ce_gym/bench/", script))]
    nodes = [n for file, name in benches for s in _source(file).statements(name) for n in ast.walk(s)]
    words = {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    ids = tuple(word.removeprefix("ce_gym/").lower() for word in words if word.startswith("ce_gym/"))
    source = _source(script)
    every = any(used == "robots" and used in source.imports for used, _ in uses(source.statements("*")))
    for path in sorted((ROOT / "assets").glob("*/*.yaml")):
        named = path.stem in words or any(word.startswith(path.stem.replace("_", "")) for word in ids)
        if path.stem == path.parent.name and (every or named):
            yield from (other.relative_to(ROOT).as_posix() for other in path.parent.glob(f"{path.stem}.*"))


@cache
def _source(file: str) -> Source:
    return Source.of((ROOT / file).read_text(encoding="utf-8"))


def _git(*arguments: str) -> str:
    """Return what git answers about the repository.

    Raises:
        LookupError: It fails.
    """
    finished = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    if finished.returncode:
        raise LookupError(finished.stderr)
    return finished.stdout
