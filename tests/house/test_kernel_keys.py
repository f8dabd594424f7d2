"""What editing a file compiles anew: the kernels that it shapes, and no others."""

import ast
import importlib.util
from functools import cache
from pathlib import Path

import pytest

import ce_gym
from ce_gym.compile import loading, source_fingerprint
from ce_gym.compile.cuda import loading as cuda_loading
from ce_gym.compile.sources import source_files
from ce_gym.envs.runtime import batch
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.tasks import VELOCITY
from ce_gym.sim import kernel_key
from ce_gym.sim.kernel_key import model_key

PACKAGE = Path(ce_gym.__file__).parent


@cache
def imports(module: str) -> tuple[tuple[str, str], ...]:
    """The module and the name in it that each import of ours in a file speaks of, wherever in the file it stands."""
    tree = ast.parse(file_of(module).read_text())
    found = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    ours = [node for node in found if node.module.split(".")[0] == "ce_gym"]
    return tuple((node.module, alias.name) for node in ours for alias in node.names)


def file_of(module: str) -> Path:
    spec = importlib.util.find_spec(module)
    assert spec
    assert spec.origin
    return Path(spec.origin)


def home(module: str, name: str) -> str:
    """The module that defines a name which may come by way of packages' `__init__`."""
    file = file_of(module)
    if file.name != "__init__.py":
        return module
    if (file.parent / f"{name}.py").exists() or (file.parent / name).is_dir():
        return f"{module}.{name}"
    return next((home(*one) for one in imports(module) if one[1] == name), module)


def closure(*modules: str) -> set[str]:
    """All modules of ours that some modules need."""
    known, ahead = set(), set(modules)
    while ahead:
        module = ahead.pop()
        known.add(module)
        ahead |= {home(*one) for one in imports(module)} - known
    return known


def files(names: tuple[str, ...]) -> set[Path]:
    return {path for name in names for path in source_files(name)}


LLVM = "ce_gym.compile.lowering.tile", "ce_gym.compile.machine_code", "ce_gym.compile.layout"
CUDA = "ce_gym.compile.cuda.source", "ce_gym.compile.cuda.nvrtc", "ce_gym.compile.layout"
SIMULATOR = "ce_gym.sim.simulator", "ce_gym.sim.substeps"
ENVIRONMENT = *SIMULATOR, *(f"ce_gym.envs.runtime.{name}" for name in ("program", "stages"))
TASKS = kernel_key.SOURCES + batch.SOURCES


@pytest.mark.parametrize(
    ("builders", "sources", "elsewhere"),
    [
        (LLVM, loading.SOURCES, ""),
        (CUDA, cuda_loading.SOURCES, ""),
        (SIMULATOR, kernel_key.SOURCES, "ce_gym.compile"),
        (ENVIRONMENT, TASKS, "ce_gym.compile"),
    ],
)
def test_a_key_covers_all_that_builds_the_program(builders, sources, elsewhere):
    """All that builders import, directly or not; what `load_kernel` covers by itself aside."""
    needed = {module for module in closure(*builders) if not (elsewhere and module.startswith(elsewhere))}
    assert len(needed) > len(builders)
    assert not {file_of(module) for module in needed} - files(sources)


def test_a_key_covers_no_other_rooms():
    rooms = {path.relative_to(PACKAGE).parts[0] for path in files(kernel_key.SOURCES)}
    assert rooms == {"model", "dynamics", "sim"}
    inside = {path.relative_to(PACKAGE).parts[:-1] for path in files(batch.SOURCES)}
    assert inside == {("envs", name) for name in ("runtime", "task", "terms")}
    assert {path.relative_to(PACKAGE).parts[0] for path in files(loading.SOURCES)} == {"compile"}


@pytest.fixture
def keys(monkeypatch):
    """`keys(file)`: the names of a simulator's and an environment's kernel after that file has been edited."""
    model = ce_gym.Model("mini_cheetah")
    program = TaskProgram(model, VELOCITY)
    read = Path.read_bytes

    def after_editing(edited=""):
        monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"#" * (path == PACKAGE / edited))
        source_fingerprint.cache_clear()
        return [loading.kernel_name(key, "float64") for key in (model_key(model), batch.kernel_key(program))]

    yield after_editing
    source_fingerprint.cache_clear()


SIMULATORS = "sim/substeps.py", "dynamics/stepping/step.py", "model/clusters.py", "compile/lowering/math.py"
ENVIRONMENTS = "envs/terms/rewards.py", "envs/task/actions.py", "envs/runtime/program.py"
NOBODYS = (
    "bench/__main__.py", "viewer/window.py", "policies/actor.py", "adapters/sb3.py", "diagnostics/scene.py",
    "envs/vector.py", "envs/rendering.py", "compile/threads.py", "compile/cache.py", "compile/cuda/host.py",
    "__init__.py", "__main__.py",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edited", "changed"),
    [
        *((path, [True, True]) for path in SIMULATORS),
        *((path, [False, True]) for path in ENVIRONMENTS),
        *((path, [False, False]) for path in NOBODYS),
    ],
)
def test_editing_a_file_renames_what_it_shapes(keys, edited, changed):
    assert (PACKAGE / edited).exists()
    before = keys()
    assert [a != b for a, b in zip(keys(edited), before, strict=True)] == changed
    assert keys() == before
