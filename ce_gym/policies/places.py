"""Find policies: files, folders of training runs, and shipped policies."""

from __future__ import annotations

import contextlib
import difflib
import zipfile
from pathlib import Path

from ce_gym.model import assets_folder
from ce_gym.policies.errors import PolicyError

FORMATS = (".zip", ".npz", ".onnx")
"""Suffixes of policy files, in the order in which a folder is searched: files from training before exported copies."""

WHERE = "a file (policy.zip, .npz or .onnx), the folder of a training run, or the name of a shipped policy"
"""The argument of `locate_policy` in words, for help texts."""


def shelf() -> Path:
    """Return the folder of shipped policies; each has a subfolder `<robot>_<task>_<level>`."""
    return assets_folder() / "policies"


def shipped_policies() -> list[str]:
    """Return the names of the policies in the package."""
    return sorted(file.parent.name for file in shelf().glob("*/policy.npz"))


def find_policy(path: str | Path) -> Path | None:
    """Return the file of a policy, or None if there is no such policy; see `locate_policy`."""
    path = Path(path)
    if path.suffix in FORMATS:
        return path if is_file(path) and not _is_other_npz(path) else None
    folders = [path, *([shelf() / path, shelf() / f"{path}_exact"] if len(path.parts) == 1 else [])]
    files = [folder / f"policy{suffix}" for folder in folders for suffix in FORMATS]
    files += [path.with_name(f"{path.name}.zip")] if path.name else []
    return next((file for file in files if is_file(file)), None)


def locate_policy(path: str | Path) -> Path:
    """Return the file of a policy.

    Args:
        path: A policy file; a folder that contains one; or the name of a shipped policy, where "_exact" may be
            omitted.

    Raises:
        PolicyError: If there is no such policy.
    """
    file = find_policy(path)
    if file is None:
        raise PolicyError(f"{path}: {_no_policy(Path(path))}")
    return file


def _no_policy(path: Path) -> str:
    """Return why there is no policy at a path, and what to do."""
    if is_file(path) and path.suffix == ".npz":
        return f"is not a policy, perhaps a rollout, which `view` shows; expected {WHERE}"
    with contextlib.suppress(OSError, ValueError):  # the system refuses some paths
        runs = (file.parent for depth in ("*", "*/*") for file in path.glob(f"{depth}/policy.json"))
        if run := next(runs, None):
            return f"no such policy; expected a run in this folder, such as {run}; `transfer` takes all of them"
    known = [*(name.removesuffix("_exact") for name in shipped_policies()), *shipped_policies()]
    close = difflib.get_close_matches(path.name, known, n=1)
    hint = f"did you mean {close[0]!r}?" if close else "`python -m ce_gym list` shows these names"
    return f"no such policy; expected {WHERE} ({hint})"


def policy_name(file: Path) -> str:
    """Return the name of a policy's file, or the name of its folder for files such as `policy.npz`."""
    folder = file.resolve().parent.name
    return folder if file.stem == "policy" and folder else file.stem


def is_file(path: Path) -> bool:
    """Return whether a regular file exists; False also for a path that the system refuses."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _is_other_npz(path: Path) -> bool:
    """Return whether a file is a readable npz of another kind, such as a rollout."""
    if path.suffix != ".npz" or not zipfile.is_zipfile(path):
        return False
    try:
        with zipfile.ZipFile(path) as arrays:
            return "record.npy" not in arrays.namelist()
    except zipfile.BadZipFile:  # the reader reports the damage
        return False
