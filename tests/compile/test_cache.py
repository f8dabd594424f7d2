"""The kernel cache: found again by another process, compiled again when damaged, done without when there is no room."""

import errno
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, cache, load_kernel, loading
from ce_gym.compile.cache import cache_folder, read_entry, write_entry

PACKAGE_PARENT = Path(sys.modules["ce_gym.compile"].__path__[0]).parents[1]
HERE = Path(__file__)
COMMAND = f"import runpy; runpy.run_path({str(HERE)!r})['main']()"


def build():
    x = y = ca.SX.sym("x", 3)
    for _ in range(20):
        y = ca.sin(y) + ca.SX([1, 2, 3]) / (2 + y * y)
    f = ca.Function("f", [x], [y])
    return Program("cached thing", (Buffer("x", 3, "rows_in"), Buffer("y", 3, "rows_out")), (Call(f, ("x",), ("y",)),))


def never():
    raise AssertionError("build was called")


def result(build, key="k"):
    """Return the result of the kernel, loaded as in a new process."""
    loading._loaded.clear()
    kernel = load_kernel(key, build)
    assert load_kernel(key, build) is kernel
    x, y = np.linspace(0, 1, 33).reshape(11, 3), np.zeros((11, 3))
    kernel({"x": x, "y": y}, 11)
    return y.tobytes()


def main():
    """Load the kernel, print its result and whether the trace was lowered; processes of `start` execute this."""
    print(result(build).hex(), "ce_gym.compile.lowering.function" in sys.modules)


def start(folder, command=COMMAND):
    variables = os.environ | {"CE_GYM_CACHE_DIR": str(folder), "PYTHONPATH": str(PACKAGE_PARENT)}
    return subprocess.Popen(
        [sys.executable, "-c", command], env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finish(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    digits, lowered = out.split()
    return bytes.fromhex(digits), lowered == "True", err


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A cache with one kernel, and what that kernel computed."""
    folder = tmp_path_factory.mktemp("original")
    computed, lowered, err = finish(start(folder))
    assert lowered
    assert err.count("\n") == 1
    assert err.startswith(f"ce_gym: compiling cached thing (float64), once; cached in {folder} ...")
    assert err.endswith(" s\n")
    return folder, computed


@pytest.mark.parametrize(("expected", "said"), [(12.4, "not kept, about 12 s ... "), (3.0, "not kept ... ")])
def test_an_estimate_is_printed_if_it_is_long(expected, said, capsys):
    with cache.announced("a thing", None, 0.0, expected):
        pass
    assert capsys.readouterr().err.startswith(f"ce_gym: compiling a thing, {said}")


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    """No kernel of other tests, and nothing said to the user yet."""
    monkeypatch.setattr(loading, "_loaded", {})
    cache._tell_once.cache_clear()


@pytest.fixture
def filled(original, tmp_path, monkeypatch):
    """Return the only file of a copy of the cache, which is in use, and the result of the kernel."""
    folder, computed = original
    shutil.copytree(folder, tmp_path / "cache")
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path / "cache"))
    (path,) = (tmp_path / "cache").iterdir()
    return path, computed


def test_another_process_builds_nothing(original):
    folder, computed = original
    assert finish(start(folder)) == (computed, False, "")


def test_damage_anywhere_is_noticed(filled):
    path, _ = filled
    good, name = path.read_bytes(), path.stem
    entry = read_entry(path.parent, name)
    for i in (*range(300), *range(300, len(good), 53)):
        path.write_bytes(good[:i] + bytes([good[i] ^ 1 << i % 8]) + good[i + 1 :])
        assert read_entry(path.parent, name) is None
    for length in range(0, len(good), 211):
        path.write_bytes(good[:length])
        assert read_entry(path.parent, name) is None
    path.write_bytes(good)
    assert read_entry(path.parent, name) == entry


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def spoil_the_layout(path):
    path.write_bytes(path.read_bytes().replace(b'"size": 3', b'"size": 4', 1))


def break_the_text(path):
    path.write_bytes(path.read_bytes().replace(b"cached thing", b"cached\xff thin"))


def cut(path):
    path.write_bytes(path.read_bytes()[:1000])


def add(path):
    path.write_bytes(path.read_bytes() + b"\0")


def empty(path):
    path.write_bytes(b"")


def remove(path):
    path.unlink()


def exchange(path):
    """Another kernel's file, whole but under this one's name."""
    write_entry(path.parent, "other", {"name": "other"}, b"code")
    (path.parent / "other.kernel").rename(path)


def link(path):
    """A link to a good file elsewhere."""
    path.rename(path.parent.parent / "elsewhere")
    path.symlink_to(path.parent.parent / "elsewhere")


def let_others_write(path):
    path.chmod(0o620)


def pipe(path):
    path.unlink()
    os.mkfifo(path, 0o600)


DAMAGES = [
    flip_a_bit,
    spoil_the_layout,
    break_the_text,
    cut,
    add,
    empty,
    remove,
    exchange,
    link,
    let_others_write,
    pipe,
]


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_entry_is_compiled_again_and_replaced(filled, damage, capfd):
    path, computed = filled
    damage(path)
    assert result(build) == computed
    assert capfd.readouterr().err.count("compiling") == 1
    assert path.is_file()
    assert not path.is_symlink()
    assert [path] == list(path.parent.iterdir())
    assert result(never) == computed
    assert capfd.readouterr().err == ""


def test_nothing_beside_the_entries_is_run(filled):
    """Neither Python beside them nor bytecode made from it, whatever its name."""
    path, computed = filled
    assert path.suffix == ".kernel"
    for name in (f"{path.stem}.py", "sitecustomize.py", "__init__.py"):
        (path.parent / name).write_text("raise SystemExit('run')")
    assert finish(start(path.parent)) == (computed, False, "")


@pytest.mark.slow
def test_processes_may_compile_at_once(tmp_path):
    both = [finish(process) for process in [start(tmp_path), start(tmp_path)]]
    assert both[0][0] == both[1][0]
    assert finish(start(tmp_path)) == (both[0][0], False, "")
    assert len(list(tmp_path.iterdir())) == 1, "temporary files stay"


class FullDisk:
    """A file on a disk that is full when `method` is called."""

    def __init__(self, file, method):
        self.file, self.method = file, method

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()
        if self.method == "close":
            no_room()

    def write(self, content):
        self.file.write(content[: len(content) // 2])
        if self.method == "write":
            no_room()


def no_room(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
@pytest.mark.parametrize("call", ["mkstemp", "write", "close", "replace"])
def test_a_full_disk_is_done_without(original, tmp_path, monkeypatch, capfd, call):
    computed = original[1]
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path))
    if call in ("write", "close"):
        opened = os.fdopen
        monkeypatch.setattr(os, "fdopen", lambda *arguments: FullDisk(opened(*arguments), call))
    else:
        monkeypatch.setattr({"mkstemp": tempfile, "replace": os}[call], call, no_room)
    assert result(build) == computed
    assert result(build) == computed
    lines = capfd.readouterr().err.splitlines()
    assert [line for line in lines if "compiling" not in line] == [
        f"ce_gym: kernels compiled now are not kept in {tmp_path}: No space left on device"
    ]
    assert not list(tmp_path.iterdir()), "half a file stays"
    monkeypatch.undo()
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path))
    assert result(build) == computed
    assert result(never) == computed


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of a process")
def test_a_file_that_the_system_cuts_off_is_done_without(tmp_path):
    """A write that fails for real, halfway."""
    limit = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (1000, 1000)); "
    _, lowered, err = finish(start(tmp_path, limit + COMMAND))
    assert lowered
    assert err.endswith(f"\nce_gym: kernels compiled now are not kept in {tmp_path}: File too large\n")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_entry(tmp_path, "k", {}, b"code")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Where temporary files go."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


def test_an_unusable_folder_is_replaced_by_a_temporary_one(tmp_path, temporary, monkeypatch, capfd):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path / "file" / "cache"))
    folder = cache_folder()
    assert folder.parent == temporary
    assert folder == cache_folder()
    assert capfd.readouterr().err == f"ce_gym: no kernels are kept in {tmp_path}/file/cache: Not a directory\n"


def test_a_folder_that_cannot_be_written_is_replaced_likewise(tmp_path, temporary, monkeypatch):
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path / "cache"))
    writable = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path / "cache" and writable(path, mode))
    assert cache_folder().parent == temporary


def test_without_any_folder_kernels_are_not_kept(original, tmp_path, temporary, monkeypatch, capfd):
    (tmp_path / "file").write_text("not a folder")
    (temporary / f"ce_gym-{os.getuid()}").write_text("not a folder")
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(tmp_path / "file"))
    assert cache_folder() is None
    assert result(build) == original[1]
    assert "ce_gym: compiling cached thing (float64), not kept ..." in capfd.readouterr().err


def test_default_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("CE_GYM_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "ce_gym"
    assert (tmp_path / "ce_gym").is_dir()
