"""The structure of the package: imports go one way, files stay small, importing is light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ce_gym

PACKAGE = Path(ce_gym.__file__).parent
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "assets" not in path.parts)
MAY_IMPORT = {
    "model": set(),
    "compile": set(),
    "dynamics": {"model"},
    "export": {"model", "dynamics"},
    "sim": {"model", "dynamics", "compile"},
    "envs": {"model", "dynamics", "compile", "sim"},
    "diagnostics": {"model", "dynamics", "compile", "sim", "envs"},
    "adapters": {"envs"},
    "policies": {"model"},
    "viewer": {"model", "dynamics", "sim", "envs", "policies"},
    "identify": {"model", "dynamics", "compile", "sim", "viewer"},
    "bench": {
        "model", "dynamics", "compile", "export", "sim", "envs", "diagnostics", "adapters", "policies", "viewer",
        "identify",
    },
}  # fmt: skip
"""What the modules of a folder may import from other folders."""
LAYERS = {
    "model": "errors table frames assets constraints coordinates drives description clusters mechanism checks"
    " generators formats load",
    "model/formats": "text_file reading placement identified standing rotor_rule rotor_links hinges motors collections"
    " contact_shapes urdf mjcf yaml",
    "compile": "system arrays program layout lowering private_files cache critical threads kernel machine_code sources"
    " loading cuda",
    "dynamics": "algebra constraints standing recursion hulls electric forces drives self_contact functions derivatives"
    " stepping evaluation model",
    "sim": "arguments tiles devices terrain placement substeps kernel_key kernels derivative_kernels schema batch"
    " pieces simulator derivatives",
    "envs": "terms task runtime policy_spec differentiable rendering base single vector registration custom",
    "export": "joint_ties mjcf_text mjcf_equalities mjcf mujoco_model mujoco_coordinates mujoco_batch mujoco_twin"
    " guesses new_robot",
    "viewer": "errors console meshes rollouts page raytrace video server feed window renderers live watch cli",
    "identify": "log held figures shots windows differences fit separable found estimate excite overlay page command",
    "bench": "measure peers soak digests fuzz speed throughput paper accuracy stability gpu exactness page __main__",
}
"""What a folder consists of, bottom first: a module imports from its own layer and from those below."""
MOST_MODULES = 14


def imported_modules(path: Path) -> set[str]:
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules.add(node.module or "")
    return modules


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def names_in(folder: Path) -> set[str]:
    inside = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    return inside - {"__init__"}


def test_every_room_has_a_rule():
    assert {room_of(path) for path in FILES} - {""} == set(MAY_IMPORT)
    for folder, layers in LAYERS.items():
        assert names_in(PACKAGE / folder) == set(layers.split()), folder


def test_folders_stay_small():
    for folder in {path.parent for path in FILES}:
        assert len(names_in(folder)) <= MOST_MODULES, folder


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path):
    room = room_of(path)
    if not room:
        return
    for module in imported_modules(path):
        if module == "ce_gym":
            assert room in ("viewer", "bench", "adapters"), f"{room} must not import the top of the package"
        elif module.startswith("ce_gym."):
            target = module.split(".")[1]
            assert target == room or target in MAY_IMPORT[room], f"{room} must not import {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_downwards_inside_a_folder(path: Path):
    for folder, names in LAYERS.items():
        inside = path.relative_to(PACKAGE).with_suffix("").as_posix().removeprefix(f"{folder}/").split("/")[0]
        layers = names.split()
        if inside not in layers or not path.is_relative_to(PACKAGE / folder):
            continue
        prefix = f"ce_gym.{folder.replace('/', '.')}."
        for module in imported_modules(path):
            if module.startswith(prefix):
                target = module.removeprefix(prefix).split(".")[0]
                assert layers.index(target) <= layers.index(inside), f"{inside} must not import {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_compile_knows_the_compiler(path: Path):
    if room_of(path) != "compile":
        assert not {m.split(".")[0] for m in imported_modules(path)} & {"llvmlite"}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_say_what_they_are_and_stay_small(path: Path):
    text = path.read_text()
    assert ast.get_docstring(ast.parse(text)), f"{path.name} has no docstring"
    assert len(text.splitlines()) <= 400


def strings_in_code(path: Path) -> list[str]:
    """Every string of a file that is not a docstring."""
    tree = ast.parse(path.read_text())
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    constants = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [node.value for node in constants if id(node) not in prose]


def test_no_robot_names_in_algorithms():
    robots = [name for name in ce_gym.robots() if not name.endswith("_bar")]  # a four-bar is a mechanism before a robot
    for path in FILES:
        if room_of(path) in ("model", "dynamics", "compile", "sim"):
            assert not [s for s in strings_in_code(path) if any(name in s for name in robots)], path


def test_only_one_file_asks_for_what_some_operating_system_lacks():
    lacking = {"sched_getaffinity", "fork", "register_at_fork", "getuid", "geteuid", "getgid", "uname", "nice"}
    modules = {"fcntl", "grp", "pwd", "resource", "termios", "pty"}
    for path in [*FILES, *(PACKAGE.parent / "train").glob("*.py")]:
        if path == PACKAGE / "compile" / "system.py":
            continue
        called = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not called & lacking, path
        assert not imported_modules(path) & modules, path
        assert not [text for text in strings_in_code(path) if "/proc/" in text], path


def test_import_is_light():
    """No learner, no viewer, no compiler is imported before it is needed."""
    heavy = ("torch", "meshcat", "stable_baselines3", "mujoco", "llvmlite", "scipy")
    code = f"import ce_gym, sys; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_training_scripts_use_public_names_only():
    public = {"ce_gym", "ce_gym.adapters", "ce_gym.policies", "ce_gym.viewer", "ce_gym.export.mujoco_twin"}
    public |= {f"ce_gym.adapters.{name}" for name in ("sb3", "sb3_asymmetric", "rsl_rl")}
    for path in (PACKAGE.parent / "train").glob("*.py"):
        ours = {m for m in imported_modules(path) if m.split(".")[0] == "ce_gym"}
        assert ours <= public, f"{path.name} imports {ours - public}"
