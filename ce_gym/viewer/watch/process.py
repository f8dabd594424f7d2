"""Show a training run in a browser during training: another process reads the files of the run and serves the page.

The page uses processor time but does not block training, and training continues if the page fails.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PATIENCE = 20.0
"""Longest time in which the page may end before it is killed [s]."""


class TrainingPage:
    """Context in which another process serves the page of training runs.

    The process ends when its standard input is closed, so it also ends if training is killed.

    Args:
        folders: Folders of the runs; the runs need not have started.
        env_id: Registered environment id.
    """

    def __init__(self, folders: Sequence[Path], env_id: str) -> None:
        self._folders, self._env_id = list(folders), env_id

    def __enter__(self) -> TrainingPage:
        """Start the process."""
        command = [sys.executable, "-m", "ce_gym", "watch", *map(str, self._folders), "--env", self._env_id]
        paths = [str(Path.cwd()), *sys.path]  # so that the page finds modules that register robots
        detached: dict[str, Any] = {"start_new_session": True}  # so that Ctrl-C reaches training only
        if sys.platform == "win32":
            detached = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(dict.fromkeys(path for path in paths if path))}
        self._process = subprocess.Popen([*command, "--until-eof"], stdin=subprocess.PIPE, env=environment, **detached)
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        with self._process:
            try:
                self._process.communicate(timeout=PATIENCE)  # closes the standard input
            except subprocess.TimeoutExpired:
                self._process.kill()
