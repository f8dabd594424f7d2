"""The kernel cache: found again by another process, rebuilt when damaged, safe for two writers."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ce_gym.compile import source_fingerprint
from ce_gym.compile.cache import cache_folder

SCRIPT = """
import sys
import numpy as np
from ce_gym.compile import Buffer, Call, Program, load_kernel
key, allowed = sys.argv[1], sys.argv[2] == "build"
def build():
    assert allowed, "build was called"
    import casadi as ca
    x = ca.SX.sym("x", 3)
    for _ in range(20):
        x0 = x if _ == 0 else y
        y = ca.sin(x0) + ca.SX([1, 2, 3]) / (2 + x0 * x0)
    f = ca.Function("f", [x], [y])
    return Program("cached thing", (Buffer("x", 3, "rows_in"), Buffer("y", 3, "rows_out")), (Call(f, ("x",), ("y",)),))
kernel = load_kernel(key, build)
assert load_kernel(key, build) is kernel
x, y = np.linspace(0, 1, 33).reshape(11, 3), np.zeros((11, 3))
kernel({"x": x, "y": y}, 11)
print(y.tobytes().hex())
print("lowering" if "ce_gym.compile.lowering.function" in sys.modules else "no lowering")
"""
PACKAGE_PARENT = Path(sys.modules["ce_gym.compile"].__path__[0]).parents[1]


def start(folder, build="build", key="k", **environment):
    variables = os.environ | {"CE_GYM_CACHE_DIR": str(folder), "PYTHONPATH": str(PACKAGE_PARENT)} | environment
    command = [sys.executable, "-c", SCRIPT, key, build]
    return subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out.splitlines(), err


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A cache with one kernel, and what that kernel printed."""
    folder = tmp_path_factory.mktemp("original")
    (result, loaded), err = finish(start(folder))
    assert loaded == "lowering"
    assert err.count("\n") == 1
    assert err.startswith(f"ce_gym: compiling cached thing (float64), once; cached in {folder} ...")
    assert err.endswith(" s\n")
    return folder, result


@pytest.fixture
def filled(original, tmp_path):
    """A copy of that cache."""
    folder, result = original
    return shutil.copytree(folder, tmp_path / "cache"), result


def test_another_process_builds_nothing(filled):
    folder, result = filled
    (again, loaded), err = finish(start(folder, "never"))
    assert again == result
    assert loaded == "no lowering"
    assert err == ""


def spoil_machine_code(folder):
    (path,) = folder.rglob("*.nbc")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def cut_machine_code(folder):
    (path,) = folder.rglob("*.nbc")
    path.write_bytes(path.read_bytes()[:1000])


def remove_machine_code(folder):
    (path,) = folder.rglob("*.nbc")
    path.unlink()


def spoil_index(folder):
    (path,) = folder.rglob("*.nbi")
    path.write_bytes(b"nonsense")


def spoil_source(folder):
    (path,) = folder.glob("kernel_*.py")
    path.write_text("raise SystemExit('not what was written')")


def spoil_record(folder):
    (path,) = folder.glob("kernel_*.json")
    path.write_text('{"files": {')


def empty_record(folder):
    (path,) = folder.glob("kernel_*.json")
    path.write_text("{}")


DAMAGES = [
    spoil_machine_code,
    cut_machine_code,
    remove_machine_code,
    spoil_index,
    spoil_record,
    empty_record,
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_entry_is_rebuilt(filled, damage):
    folder, result = filled
    damage(folder)
    (rebuilt, _), err = finish(start(folder))
    assert rebuilt == result
    assert "compiling" in err
    (again, _), err = finish(start(folder, "never"))
    assert again == result
    assert err == ""


def test_a_damaged_source_is_restored(filled):
    folder, result = filled
    spoil_source(folder)
    (again, _), _ = finish(start(folder, "never"))
    assert again == result


def test_processes_may_compile_at_once(tmp_path):
    both = [start(tmp_path), start(tmp_path)]
    results = [finish(process)[0][0] for process in both]
    assert results[0] == results[1]
    (again, _), _ = finish(start(tmp_path))
    assert again == results[0]
    assert not [path for path in tmp_path.iterdir() if path.suffix not in (".py", ".json", "")], "temporary files stay"


def test_an_unusable_folder_is_replaced_by_a_temporary_one(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    folder = cache_folder()
    assert folder.parent == tmp_path / "tmp"
    assert folder == cache_folder()


def test_default_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("CE_GYM_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "ce_gym"
    assert (tmp_path / "ce_gym").is_dir()


def test_fingerprint_follows_the_sources(tmp_path, monkeypatch):
    package = tmp_path / "some_package"
    (package / "inner").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "inner" / "thing.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = source_fingerprint("some_package")
    source_fingerprint.cache_clear()
    assert source_fingerprint("some_package") == before
    (package / "inner" / "thing.py").write_text("x = 2\n")
    source_fingerprint.cache_clear()
    assert source_fingerprint("some_package") != before
    with pytest.raises(ValueError, match="package 'no_such_package': not found"):
        source_fingerprint("no_such_package")
