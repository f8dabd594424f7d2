"""The folder of a training run has one owner at a time, and a run that is there is not replaced by mistake."""

import contextlib
import multiprocessing
import os
import pty
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from point_mass import ID
from toy import FAST, jobs

from ce_gym.__main__ import main
from ce_gym.files import guarded, write_whole
from ce_gym.learn.runs.folder import LOCK, remove, run_folder, unused_folder
from ce_gym.learn.runs.progress import STEPS, read_rows
from ce_gym.policies import load_policy

TRAIN = ["train", ID, *FAST, "steps=2048"]


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A finished run, in its default folder."""
    monkeypatch.chdir(tmp_path)
    assert main(TRAIN) == 0
    return Path("runs/default")


def test_a_finished_run_is_not_replaced_without_force(run, capsys):
    before = files(run)
    assert main([*TRAIN, "--out", str(run)]) == 2
    assert "--out runs/default: has a run already; expected --resume" in capsys.readouterr().err
    assert files(run) == before
    assert main([*TRAIN, "--seed", "1", "--out", str(run), "--force"]) == 0
    assert load_policy(run).record["seed"] == 1
    assert [row[STEPS] for row in read_rows(run / "progress.csv")] == [1024.0, 2048.0]


def test_force_removes_the_files_of_another_learner(run):
    assert main([*TRAIN, "--algo", "sb3", "--out", str(run), "--force"]) == 0
    assert {file.name for file in run.glob("policy.*")} == {"policy.zip", "policy.json", "policy.learner.npz"}


def test_a_new_run_has_a_folder_with_a_number(run):
    before = files(run)
    assert main(TRAIN) == 0
    assert files(run) == before
    assert load_policy("runs/default-2").record["finished"]
    assert unused_folder(run) == Path("runs/default-3")
    assert [str(job.out) for job in jobs(ID, "--seeds", "3", "4")] == [f"runs/default-3/seed_{n}" for n in (3, 4)]


def test_resume_continues_in_the_folder_of_its_run(run):
    assert main(["train", "--resume", str(run), *FAST, "steps=4096"]) == 0
    assert load_policy(run).record["steps"] == 4096
    assert [str(job.out) for job in jobs("--resume", str(run), "--env-arg", "horizon=9")] == ["runs/default-2"]
    (run / "checkpoints").mkdir(exist_ok=True)
    earlier = next((run / "checkpoints").glob("policy_*[0-9].npz"))
    assert [str(job.out) for job in jobs("--resume", str(earlier))] == ["runs/default-2"]


def test_a_policy_that_the_command_reads_is_not_replaced_unless_it_is_continued(run):
    before = files(run)
    with guarded() as guard:
        guard.force = True
        load_policy(run)  # a teacher, for example
        with run_folder(run) as replaced, pytest.raises(FileExistsError, match="the command reads this file"):
            remove(replaced)
        assert files(run) == before
        with run_folder(run, run / "policy.npz") as replaced:
            remove(replaced)
            write_whole({run / "policy.npz": b"next"})
    assert files(run) == before | {"policy.npz": b"next"}


def test_ctrl_c_before_the_first_update_leaves_no_run(tmp_path, capsys, monkeypatch):
    def interrupted(learner):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)

    monkeypatch.setattr("ce_gym.learn.learners.ppo.PPO.iterate", interrupted)
    assert main([*TRAIN, "--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().err.endswith("\nce_gym: interrupted\n")
    assert files(tmp_path) == {}


def hold(folder: Path, log: Path, seed: int) -> None:
    """Enter and leave a folder at random, write when, and sometimes end without leaving."""
    rng = random.Random(seed)
    for _ in range(20):
        time.sleep(rng.uniform(0, 0.01))
        with contextlib.suppress(FileExistsError), run_folder(folder), log.open("a") as file:
            file.write(f"in {seed}\n")
            file.flush()
            time.sleep(rng.uniform(0, 0.005))
            if rng.random() < 0.05:
                os.kill(os.getpid(), signal.SIGKILL)
            file.write(f"out {seed}\n")


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
def test_processes_in_one_folder_take_turns(tmp_path):
    """Processes that enter one folder and are killed at random never write at the same time."""
    context = multiprocessing.get_context("fork")
    log = tmp_path / "log"
    processes = [context.Process(target=hold, args=(tmp_path / "run", log, seed)) for seed in range(6)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode in (0, -signal.SIGKILL)
    owner, entries = None, 0
    for line in log.read_text().splitlines():
        what, seed = line.split()
        killed = owner is not None and processes[int(owner)].exitcode == -signal.SIGKILL
        if what == "in":
            assert owner is None or killed
            owner, entries = seed, entries + 1
        else:
            assert owner == seed
            owner = None
    assert entries > 20


def test_a_lock_of_a_process_that_has_ended_is_no_obstacle(tmp_path):
    (tmp_path / LOCK).write_text("process 1 on this machine")
    with run_folder(tmp_path), pytest.raises(FileExistsError, match=f"process {os.getpid()} on "), run_folder(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a terminal of POSIX")
def test_a_terminal_that_closes_ends_training_with_a_policy(tmp_path):
    """SIGHUP comes when nothing can be printed any more."""
    ours, theirs = pty.openpty()
    words = [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; import point_mass, ce_gym.__main__ as m; "
             f"sys.exit(m.main({['train', ID, '--out', str(tmp_path), *FAST, 'steps=1e9']!r}))"]  # fmt: skip
    process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    try:
        while not (tmp_path / "progress.csv").exists():
            assert process.poll() is None, os.read(ours, 10000).decode()
            time.sleep(0.05)
        os.close(ours)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 130
    finally:
        process.kill()
    assert not load_policy(tmp_path).record["finished"]
    steps = [row[STEPS] for row in read_rows(tmp_path / "progress.csv")]
    assert load_policy(tmp_path).record["steps"] == steps[-1]
    assert np.all(np.diff(steps) > 0)
