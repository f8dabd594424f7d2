"""Every Python block of README and docs runs; every command in them exists.

The Python blocks of a page are one script, run from top to bottom in an empty folder. A block of another language whose
first line is a comment with a file name is that file, and `cp` copies from the repository, so a page can be followed.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pages import PAGES, ROOT, blocks, commands, name_of, script

import ce_gym
from ce_gym import __main__ as command_line
from ce_gym.bench import __main__ as benchmarks

WITH_CODE = [page for page in PAGES if any(block.language == "python" for block in blocks(page))]
ELSEWHERE = ("ray start", "python3 -m venv", "pip install torch", "python -c", "source ")
"""Beginnings of commands that are not ours to check."""
RUN = """
import runpy
from ce_gym.compile import machine_code

machine_code.GENERATION = machine_code.OPTIMISATION = 0  # as in tests/conftest.py
runpy.run_path("page.py", run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE, ids=name_of)
def test_python_blocks_run(page: Path, tmp_path: Path):
    for command in commands(page):
        if command.startswith("cp "):
            _, source, target = command.split()
            shutil.copy(ROOT / source, tmp_path / target)
    (tmp_path / "page.py").write_text(script(page), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run(
        [sys.executable, "-c", RUN], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, f"{name_of(page)}\n{result.stdout[-2000:]}\n{result.stderr[-3000:]}"


def test_pages_have_code():
    pages = {"README.md", "docs/tutorials/first_steps.md", "docs/tutorials/own_robot.md", "docs/how-to/extend.md"}
    assert pages <= {name_of(p) for p in WITH_CODE}


def test_examples_register_environments():
    """A linter removes an import that is not used; `register_envs` uses it, and an id `module:id` imports by itself."""
    made = re.compile(r"gymnasium\.make(?:_vec)?\(\s*\"(?!\w+:)")
    scripts = {name_of(page): script(page) for page in PAGES}
    scripts |= {str(path.relative_to(ROOT)): path.read_text() for path in (ROOT / "train").rglob("*.py")}
    makers = {name: text for name, text in scripts.items() if made.search(text)}
    assert len(makers) >= 9
    assert [name for name, text in makers.items() if "gymnasium.register_envs(" not in text] == []


def test_commands_exist():
    """Subcommands, options, scripts, environments, extras and make targets of all commands in all pages."""
    wrong = []
    for page in PAGES:
        for command in commands(page):
            try:
                check_command(command)
            except (Exception, SystemExit) as error:  # a command that cannot be parsed fails in many ways
                wrong.append(f"{name_of(page)}: {command}: {error}")
    assert wrong == []


def check_command(command: str) -> None:
    """Raise an error if a command cannot work."""
    words = [word for word in shlex.split(command, comments=True) if word not in ("...",)]
    while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
        words.pop(0)
    if words:
        words[0] = Path(words[0]).name  # of an environment that the page has made
    if not words or " ".join(words).startswith(ELSEWHERE):
        return
    if words[0] == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets)
    elif words[0] == "pip":
        check_extras(words)
    elif words[0] == "cp":
        assert (ROOT / words[1]).is_file()
    elif words[:2] == ["python", "-m"]:
        check_module(words[2], words[3:])
    else:
        assert words[0] == "python", "unknown kind of command"
        check_script(ROOT / words[1], words[2:])


def check_extras(words: list[str]) -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    what, extras = re.fullmatch(r"(ce_gym|\.)(?:\[([\w,-]+)\])?", words[-1]).groups()
    assert words[:2] == ["pip", "install"]
    assert set(extras.split(",") if extras else ()) <= set(known), what


def test_the_table_of_extras_is_complete():
    page = (ROOT / "docs" / "how-to" / "install.md").read_text(encoding="utf-8").partition("## Systems")[0]
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert sorted(re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE)) == sorted(known)


def check_module(module: str, words: list[str]) -> None:
    if module == "ce_gym" and words[:1] != ["bench"]:
        if len(words) == 1:  # a subcommand by its name only
            with pytest.raises(SystemExit, match=r"^0$"):
                command_line._parser().parse_args([*words, "--help"])
        elif words:
            command_line._parser().parse_args(words)
        return
    assert module in ("ce_gym", "ce_gym.bench")
    named = words if module == "ce_gym.bench" else words[1:]
    if named:
        assert named[0] in benchmarks.BENCHMARKS
        parser = argparse.ArgumentParser()
        parser.add_argument("--json", metavar="FILE")
        benchmarks.load(named[0]).add_arguments(parser)
        parser.parse_args(named[1:])


def check_script(path: Path, words: list[str]) -> None:
    """The script exists, and so do its options and environments; it is read, not imported, because torch is slow."""
    script = ast.parse(path.read_text())
    beside = [path.with_name(f"{n.module}.py") for n in ast.walk(script) if isinstance(n, ast.ImportFrom)]
    beside.append(ROOT / "ce_gym" / "policies" / "arguments.py")  # --env and --env-arg of all scripts
    trees = [script, *(ast.parse(file.read_text()) for file in beside if file.exists())]
    calls = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call)]
    adding = [c for c in calls if isinstance(c.func, ast.Attribute) and c.func.attr == "add_argument"]
    options = {a.value for call in adding for a in call.args if isinstance(a, ast.Constant)}
    assert {word for word in words if word.startswith("--")} <= options | {"--help"}
    shipped = [word for word in words if word.startswith("ce_gym/")]
    assert set(shipped) <= set(ce_gym.environment_ids())
