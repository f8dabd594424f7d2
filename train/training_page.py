"""The page of a training run, `--page`: another process serves it, and reads what training writes into its folder.

So training is not slowed but by the processor time that the page takes, and lives on if the page does not.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from run_folder import going_on

PERIOD = 5.0
"""Between two policies that are written for the page [s]."""

PRESENT = "present"
"""Folder of these policies; it is removed at the end."""

PATIENCE = 20.0
"""How long a page may take to end before it is killed [s]."""


class TrainingPage:
    """Serves the page of runs, from a process of its own, for as long as the context lasts.

    The process ends as soon as its standard input does: also if training is killed.

    Args:
        folders: Of the runs, which need not have begun.
        env_id: Registered environment id.
    """

    def __init__(self, folders: Sequence[Path], env_id: str) -> None:
        self._folders, self._env_id = list(folders), env_id

    def __enter__(self) -> TrainingPage:
        """Start the process."""
        command = [sys.executable, "-m", "ce_gym", "watch", *map(str, self._folders), "--env", self._env_id]
        paths = [str(Path.cwd()), *sys.path]  # the module that registers a robot is found there as it is here
        alone: dict[str, Any] = {"start_new_session": True}  # a Ctrl-C is meant for training
        if sys.platform == "win32":
            alone = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(dict.fromkeys(path for path in paths if path))}
        self._process = subprocess.Popen([*command, "--until-eof"], stdin=subprocess.PIPE, env=environment, **alone)
        return self

    def __exit__(self, *_: object) -> None:
        """End it, and remove the policies written for it."""
        with self._process:
            try:
                self._process.communicate(timeout=PATIENCE)  # closes its input
            except subprocess.TimeoutExpired:
                self._process.kill()
        for folder in self._folders:
            shutil.rmtree(folder / PRESENT, ignore_errors=True)


class Present:
    """Writes the present policy of a run now and then.

    Args:
        save: Writes it as a path says, without ending.
        out: Folder of the run.
        wanted: Whether anybody asked for it.
    """

    def __init__(self, save: Callable[[Path], Any], out: Path, wanted: bool) -> None:
        self._save, self._path = save, out / PRESENT / "policy"
        self._due = 0.0 if wanted else float("inf")

    def keep(self) -> None:
        """Write the policy if the last one is old."""
        if time.monotonic() < self._due:
            return
        with going_on():
            self._save(self._path)
        self._due = time.monotonic() + PERIOD
