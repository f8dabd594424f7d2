"""The structure of the package: imports go one way at every level, importing is light, algorithms name no robot."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import ce_gym

PACKAGE = Path(ce_gym.__file__).parent
TRAIN = PACKAGE.parent / "train"
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "assets" not in path.parts)
MAY_IMPORT = {
    "model": set(),
    "compile": set(),
    "dynamics": {"model", "compile"},  # `Model` runs kernels
    "export": {"model", "dynamics"},
    "sim": {"model", "dynamics", "compile"},
    "numba": {"model", "dynamics", "compile", "sim", "envs"},
    "envs": {"model", "dynamics", "compile", "sim"},
    "diagnostics": {"model", "dynamics", "compile", "sim", "envs"},
    "adapters": {"model", "envs", "policies"},
    "policies": {"model"},
    "viewer": {"model", "dynamics", "sim", "envs", "policies"},
    "new_robot": {"model", "dynamics", "viewer"},
    "new_project": {"model", "envs", "learn"},
    "identify": {"model", "dynamics", "compile", "sim", "viewer"},
    "learn": {"model", "dynamics", "compile", "export", "envs", "adapters", "policies", "viewer"},
    "bench": {
        "model", "dynamics", "compile", "export", "sim", "envs", "diagnostics", "adapters", "policies", "viewer",
        "identify", "numba",
    },
}  # fmt: skip
"""The folders of the package, and the other folders that the modules of each may import."""
LEARN_MAY_IMPORT = {
    "networks": set(),
    "runs": set(),
    "learners": {"networks", "runs"},
    "training": {"runs"},  # and learners by name
    "study": {"runs", "training"},
    "evaluation": {"runs", "training"},
    "commands": {"runs", "training", "study", "evaluation"},
}
"""The same within `ce_gym/learn`."""
MAY_IMPORT_THE_PACKAGE = ("viewer", "bench", "adapters")


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported_modules(path: Path) -> set[str]:
    """Return the modules that a file imports anywhere, also inside functions and for type checkers only."""
    modules = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules.add(node.module or "")
            modules |= {f"{node.module}.{alias.name}" for alias in node.names}
    return modules


def room_of(path: Path) -> str:
    """Return the folder of the package that a file lies in; empty for a file of the package itself."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def imports_between(folder: Path, prefix: str) -> dict[str, set[str]]:
    """Return for each module and subfolder of a folder which of its siblings it imports.

    Args:
        folder: The folder.
        prefix: How absolute imports of its modules begin, "ce_gym.sim." for example; empty for a folder of scripts.
    """
    files = {path: path.relative_to(folder).parts[0].removesuffix(".py") for path in folder.rglob("*.py")}
    graph: dict[str, set[str]] = {name: set() for name in files.values() if name != "__init__"}
    for path, name in files.items():
        siblings = {m.removeprefix(prefix).split(".")[0] for m in imported_modules(path) if m.startswith(prefix)}
        if name in graph:
            graph[name] |= siblings & graph.keys() - {name}
    return graph


def cycles() -> Iterator[str]:
    """Iterate over the import cycles among siblings of any folder of the package and of `train/`."""
    for folder in sorted({path.parent for path in FILES} - {PACKAGE}) + [TRAIN]:
        dotted = ".".join(folder.relative_to(PACKAGE.parent).parts)
        graph = imports_between(folder, "" if folder == TRAIN else f"{dotted}.")
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            yield f"{dotted}: {' -> '.join(error.args[1])}"


def test_no_two_modules_import_each_other():
    assert list(cycles()) == []


def test_folders_import_only_what_lies_below():
    assert {room_of(path) for path in FILES} - {""} == set(MAY_IMPORT)
    wrong = []
    for path in FILES:
        room = room_of(path)
        for module in imported_modules(path) if room else ():
            if module == "ce_gym" and room not in MAY_IMPORT_THE_PACKAGE:
                wrong.append(f"{path.relative_to(PACKAGE)} imports the top of the package")
            target = module.removeprefix("ce_gym.").split(".")[0]
            if module.startswith("ce_gym.") and target in MAY_IMPORT and target not in MAY_IMPORT[room] | {room}:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {module}")
            if module.split(".")[0] == "llvmlite" and room not in ("compile", "learn"):
                wrong.append(f"{path.relative_to(PACKAGE)} imports the compiler")
    assert wrong == []


def test_rooms_of_learn_import_only_what_lies_below():
    graph = imports_between(PACKAGE / "learn", "ce_gym.learn.")
    assert graph.keys() == LEARN_MAY_IMPORT.keys()
    assert {room: wrong for room, below in graph.items() if (wrong := below - LEARN_MAY_IMPORT[room])} == {}


def test_every_file_says_what_it_is():
    assert [str(path) for path in FILES if not ast.get_docstring(parsed(path))] == []


def strings_in_code(path: Path) -> list[str]:
    """Every string of a file that is not a docstring."""
    tree = parsed(path)
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    constants = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [node.value for node in constants if id(node) not in prose]


def test_no_robot_names_in_algorithms():
    robots = [name for name in ce_gym.robots() if not name.endswith("_bar")]  # a four-bar is a mechanism before a robot
    for path in FILES:
        if room_of(path) in ("model", "dynamics", "compile", "sim"):
            assert not [s for s in strings_in_code(path) if any(name in s for name in robots)], path


def test_only_one_file_uses_what_some_operating_systems_lack():
    lacking = {"sched_getaffinity", "fork", "register_at_fork", "getuid", "geteuid", "getgid", "uname", "nice"}
    modules = {"fcntl", "grp", "pwd", "resource", "termios", "pty"}
    for path in [*FILES, *TRAIN.glob("*.py")]:
        if path == PACKAGE / "compile" / "system.py":
            continue
        called = {node.attr for node in ast.walk(parsed(path)) if isinstance(node, ast.Attribute)}
        assert not called & lacking, path
        assert not imported_modules(path) & modules, path
        assert not [text for text in strings_in_code(path) if "/proc/" in text], path


def test_import_is_light():
    """No learner, no viewer, no compiler is imported before it is needed."""
    heavy = ("torch", "numba", "tqdm", "tensorboard", "meshcat", "stable_baselines3", "mujoco", "llvmlite", "scipy")
    light = "import ce_gym, ce_gym.__main__, ce_gym.learn; ce_gym.learn.train, ce_gym.__main__._parser()"
    code = f"{light}; import sys; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_training_scripts_use_public_names_only():
    public = ("ce_gym.adapters", "ce_gym.console", "ce_gym.files", "ce_gym.learn", "ce_gym.policies", "ce_gym.viewer")
    public += ("ce_gym.__main__", "ce_gym.export.mujoco_twin")
    for path in TRAIN.rglob("*.py"):
        ours = {name for name in imported_modules(path) if name.startswith("ce_gym.")}
        packages = {name for name in ours if hasattr(ce_gym, name.removeprefix("ce_gym."))}
        hidden = {name for name in ours - packages if not name.startswith(public)}
        assert not hidden, f"{path.relative_to(TRAIN)} imports {hidden}"
