"""Machine code is taken from nowhere where another user could have put it."""

import os
from pathlib import Path

import pytest

from ce_gym.compile import cache
from ce_gym.compile.cache import cache_folder, read_entry, write_entry
from ce_gym.compile.private_files import prepare_folder, read_file

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions are not mode bits here")


@pytest.fixture
def folder(tmp_path):
    """A folder of this user's, in another."""
    path = tmp_path / "above" / "cache"
    prepare_folder(path)
    return path


def give_away(path: Path, monkeypatch) -> None:
    """Make another user's of a file; who may not, becomes another user."""
    if os.geteuid() == 0:
        os.chown(path, 65534, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 65534)


def test_what_is_made_is_ours_alone_whatever_the_umask(tmp_path):
    before = os.umask(0)
    try:
        prepare_folder(tmp_path / "a" / "b")
        write_entry(tmp_path / "a" / "b", "k", {}, b"code")
    finally:
        os.umask(before)
    modes = [path.stat().st_mode & 0o777 for path in sorted((tmp_path / "a").rglob("*"))]
    assert [(tmp_path / "a").stat().st_mode & 0o777, *modes] == [0o700, 0o700, 0o600]
    prepare_folder(tmp_path / "a" / "b")


@pytest.mark.parametrize("mode", [0o770, 0o720, 0o707, 0o702, 0o1777])
def test_a_folder_that_others_may_write_is_refused(folder, mode):
    folder.chmod(mode)
    with pytest.raises(PermissionError, match=f"^other users may write {folder}; expected what `chmod go-w` leaves$"):
        prepare_folder(folder)


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_folder_that_others_may_exchange_is_refused(folder, mode):
    folder.parent.chmod(mode)
    with pytest.raises(PermissionError, match=f"^other users may write {folder.parent};"):
        prepare_folder(folder)


def test_a_sticky_folder_above_is_harmless(folder):
    folder.parent.chmod(0o1777)
    prepare_folder(folder)


@pytest.mark.parametrize("above", [False, True])
def test_another_users_folder_is_refused(folder, above, monkeypatch):
    path = folder.parent if above else folder
    path.chmod(0o1755)
    give_away(path, monkeypatch)
    with pytest.raises(PermissionError, match=r"belongs to another user$"):
        prepare_folder(folder)


def test_files_of_others_are_not_read(folder, monkeypatch):
    write_entry(folder, "k", {}, b"code")
    assert read_entry(folder, "k") == ({}, b"code")
    give_away(folder / "k.kernel", monkeypatch)
    with pytest.raises(PermissionError, match="other users could have written it"):
        read_file(folder / "k.kernel")
    assert read_entry(folder, "k") is None


def test_only_regular_files_are_read(folder):
    os.mkfifo(folder / "pipe", 0o600)
    (folder / "folder").mkdir()
    (folder / "file").write_bytes(b"content")
    (folder / "link").symlink_to("file")
    for name in ("pipe", "folder", "link", "missing"):
        with pytest.raises(OSError, match=name):
            read_file(folder / name)
    assert read_file(folder / "file") == b"content"


def test_links_to_the_folder_are_followed_and_what_they_lead_to_is_judged(folder, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    cache._tell_once.cache_clear()
    link = tmp_path / "link"
    link.symlink_to(folder)
    monkeypatch.setenv("CE_GYM_CACHE_DIR", str(link))
    assert cache_folder() == folder
    folder.parent.chmod(0o777)
    assert cache_folder().parent == tmp_path / "tmp"
    assert cache_folder().parent == tmp_path / "tmp"
    said = capfd.readouterr().err
    assert said == (
        f"ce_gym: no kernels are kept in {folder}: "
        f"other users may write {folder.parent}; expected what `chmod go-w` leaves\n"
    )
