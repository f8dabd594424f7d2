"""Several levels and seeds by one command: folders, what is kept, what is continued, and policies of all runs."""

from types import SimpleNamespace

import pytest
from point_mass import ID
from toy import FAST, jobs

from ce_gym.__main__ import main
from ce_gym.learn.commands import train as command
from ce_gym.learn.study import policies_in
from ce_gym.policies import load_policy, read_actor, write_npz

STUDY = ["train", ID, *FAST, "--steps", "600", "--transmission", "exact", "none", "--seeds", "0", "1"]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    assert main([*STUDY, "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def trainings(monkeypatch):
    """The training runs begun during a test: level, seed, policy to continue."""
    begun = []
    run_job = command.run_job

    def run(job):
        begun.append((job.env_kwargs["transmission"], job.seed, job.resume))
        return run_job(job)

    monkeypatch.setattr(command, "run_job", run)
    return begun


def write_finished(policy, finished):
    """Write into the record of a policy whether its training has finished."""
    actor, record = read_actor(policy)
    write_npz(actor, record | {"finished": finished}, policy)


def test_every_level_and_seed_is_trained(study):
    assert policies_in(study) == [
        study / level / f"seed_{s}" / "policy.npz" for level in ("exact", "none") for s in (0, 1)
    ]
    for policy in policies_in(study):
        record = load_policy(policy).record
        assert (record["transmission"], f"seed_{record['seed']}") == policy.parts[-3:-1]
    assert policies_in(study / "none" / "seed_1") == [study / "none" / "seed_1" / "policy.npz"]


@pytest.mark.parametrize(
    ("words", "folders"),
    [
        ([], ["default"]),
        (["--transmission", "none"], ["default-none"]),
        (["--seeds", "3", "4"], ["default/seed_3", "default/seed_4"]),
        (["--transmission", "none", "--seeds", "3", "4"], ["default-none/seed_3", "default-none/seed_4"]),
        (["--transmission", "none", "exact"], ["default/none", "default/exact"]),
        (["--transmission", "none", "exact", "--seeds", "3"], ["default/none", "default/exact"]),
        (["--transmission", "none", "exact", "--algo", "sb3"], ["default-sb3/none", "default-sb3/exact"]),
    ],
)
def test_folders_have_a_part_for_each_choice(words, folders):
    assert [str(job.out) for job in jobs(ID, *words)] == [f"runs/{folder}" for folder in folders]


def test_a_second_call_trains_only_what_is_missing(study, trainings, capsys):
    policy = study / "none" / "seed_1" / "policy.npz"
    write_finished(policy, False)
    assert main([*STUDY, "--out", str(study)]) == 0
    assert trainings == [("none", 1, policy)]
    assert capsys.readouterr().out.count("finished earlier: ") == 3
    assert load_policy(policy).record["finished"]


def test_an_interrupted_study_is_continued_by_the_same_command(study, monkeypatch, capsys):
    policy = study / "exact" / "seed_1" / "policy.npz"
    record = load_policy(policy).record
    write_finished(policy, False)
    stopped = SimpleNamespace(interrupted=True, policy=policy, record=record)
    monkeypatch.setattr(command, "run_job", lambda job: stopped)
    assert main([*STUDY, "--out", str(study)]) == 130
    assert "interrupted; continue with: the same command" in capsys.readouterr().out
    write_finished(policy, True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "700"], "trained with steps = 600, requested 700; give another --out folder"),
        (["--env-arg", "horizon=9"], "trained with horizon = None, requested 9; give another --out folder"),
    ],
)
def test_a_run_of_another_kind_is_not_overwritten(words, message, study, trainings, capsys):
    assert main([*STUDY, "--out", str(study), *words]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith(f"ce_gym: --out {study}/exact/seed_0/policy.npz: ")
    assert message in error
    assert "\n" not in error
    assert not trainings
