"""What the figures of a benchmark depend on: the modules that it reaches by imports, and the files of its robots.

Two versions of a module are equal if they do the same: comments, docstrings, annotations, imports and the texts of
errors do not count. So a figure is stale when what it was measured with does something else, not when it reads better.
Versions of other packages, and the machine, are not looked at.
"""

from __future__ import annotations

import ast
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[3]
SHOWN = ("ce_gym/viewer/", "ce_gym/bench/measure/machine.py", "ce_gym/bench/measure/report.py")
"""What shows figures and has no part in them; so have modules of the name `plots`."""


def benchmark_file(name: str) -> str:
    """Return the file of a benchmark: a module of `bench`, the module `benchmark` of a package, or a module in one."""
    bench = ROOT / "ce_gym" / "bench"
    candidates = (bench / f"{name}.py", bench / name / "benchmark.py", *bench.glob(f"*/{name}.py"))
    return next(path for path in candidates if path.exists()).relative_to(ROOT).as_posix()


@cache
def files(script: str) -> frozenset[str]:
    """Return the files that a module or script depends on, itself included, relative to the repository.

    Args:
        script: Its file, relative to the repository.
    """
    found, left = set[str](), [script]
    while left:
        name = left.pop()
        if name not in found and not name.startswith(SHOWN) and not name.endswith("/plots.py"):
            found.add(name)
            left += imported(name)
    return frozenset(found | set(_robot_files(script, found)))


def imported(name: str) -> Iterator[str]:
    """Yield the files of the repository that a file imports anywhere; of packages those that the names are from."""
    for node in ast.walk(_tree(name)):
        if isinstance(node, ast.Import):
            yield from (file for alias in node.names for file in _file(alias.name, name))
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (file for alias in node.names for file in _named(node.module, alias.name, name))


def changed(script: str, commit: str) -> list[str]:
    """Return those of `files` that do not do the same at a commit, sorted.

    Raises:
        LookupError: This is no repository that knows the commit.
    """
    different = _git("diff", "--name-only", commit, "--", *sorted(files(script)))
    return [name for name in different.splitlines() if not _same(name, commit)]


def meaning(text: str, suffix: str) -> Any:
    """Return what of a file's text has a part in figures, to compare with `==`."""
    if suffix == ".py":
        return ast.dump(_Bare().visit(ast.parse(text)))
    return yaml.safe_load(text) if suffix == ".yaml" else ElementTree.canonicalize(text, strip_text=True)


class _Bare(ast.NodeTransformer):
    """Takes away what does nothing, or only fails with other words."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        return None if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise()

    def visit_Import(self, node: ast.Import) -> None: ...

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None: ...

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return ast.arg(node.arg)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)


def _same(name: str, commit: str) -> bool:
    """Whether a file of that commit and of today mean the same; one that was not there does not."""
    try:
        then = _git("show", f"{commit}:{name}")
    except LookupError:
        return False
    now = ROOT / name
    return now.exists() and meaning(then, now.suffix) == meaning(now.read_text(encoding="utf-8"), now.suffix)


def _named(module: str, name: str, by: str) -> Iterator[str]:
    """Yield the file that a name of a module comes from: a module itself, or, of a package, what it imports it from."""
    inner = _file(f"{module}.{name}", by)
    outer = _file(module, by)
    if inner or not outer or not outer[0].endswith("__init__.py"):
        yield from inner or outer
        return
    for node in _tree(outer[0]).body:
        if isinstance(node, ast.ImportFrom) and node.module and name in [a.asname or a.name for a in node.names]:
            yield from _named(node.module, name, outer[0])
            return
    yield outer[0]


def _file(module: str, by: str) -> list[str]:
    """Return the file of a module of the repository, imported by a file of it; nothing for others."""
    path = module.replace(".", "/")
    for start in (Path(), Path(by).parent):
        for end in (f"{path}.py", f"{path}/__init__.py"):
            if (ROOT / start / end).exists():
                return [(start / end).as_posix()]
    return []


def _robot_files(script: str, modules: set[str]) -> Iterator[str]:
    """Yield the files of the robots that the modules of a benchmark name; of all if it asks which there are."""
    named = [name for name in modules if name.startswith("ce_gym/bench/")]
    nodes = [node for name in {script, *named} for node in ast.walk(_tree(name))]
    words = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    calls = [node.func for node in ast.walk(_tree(script)) if isinstance(node, ast.Call)]
    every = any(isinstance(function, ast.Name) and function.id == "robots" for function in calls)
    for path in sorted((ROOT / "assets").glob("*/*.yaml")):
        if path.stem == path.parent.name and (every or path.stem in words):
            yield from (other.relative_to(ROOT).as_posix() for other in path.parent.glob(f"{path.stem}.*"))


@cache
def _tree(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text(encoding="utf-8"))


def _git(*arguments: str) -> str:
    """Return what git answers about the repository.

    Raises:
        LookupError: It fails.
    """
    finished = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    if finished.returncode:
        raise LookupError(finished.stderr)
    return finished.stdout
