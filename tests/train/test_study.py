"""A small study of a toy: which runs are made in which order, how it goes on, and what its rows say."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import study_file
from bootstrap import interquartile_mean
from point_mass import ID
from study import main
from study_file import read_study
from study_tables import answer, loss, losses, points, samples

import ce_gym

FIGURES = {"decides": "velocity_error", "metrics": ["velocity_error"], "motors": []}
TRIAL = {"env": ID, "steps": 20_000, **FIGURES, "seconds": 1.0}
TOY = {
    "seeds": [1, 2],
    "tasks": {"push": TRIAL},
    "arms": {
        "exact": {"env_args": {"transmission": "exact"}, "training": {}, "turn": 0},
        "varied": {"env_args": {"transmission": "none"}, "training": {"horizon": 30}, "turn": 1},
        "none": {"env_args": {"transmission": "none"}, "training": {}, "turn": 0},
    },
    "judged": {
        "exact": {"env_args": {"transmission": "exact"}, "episodes": 8, "robots": 2, "decides": True},
        "own": {"env_args": {}, "episodes": 4, "robots": 2, "decides": True},
    },
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a study that is done, and its arguments."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "toy.yaml").write_text(json.dumps(TOY))
    argv = [str(folder / "toy.yaml"), str(folder / "toy.csv"), "--runs", str(folder / "runs")]
    assert main(argv) == 0
    return folder, argv


@pytest.fixture
def trainings(monkeypatch):
    """The training runs begun during a test."""
    import fast_ppo

    begun, really_train = [], fast_ppo.train

    def train(job):
        begun.append((job.env_kwargs["transmission"], job.seed, job.resume))
        return really_train(job)

    monkeypatch.setattr("fast_ppo.train", train)
    return begun


def rows_of(folder):
    return list(csv.DictReader((folder / "toy.csv").open(newline="")))


def test_runs_are_made_seed_by_seed_and_judged_in_every_way(made):
    rows = rows_of(made[0])
    order = [(row["arm"], row["seed"]) for row in rows]
    assert order == [("exact", "1"), ("none", "1"), ("exact", "2"), ("none", "2"), ("varied", "1"), ("varied", "2")]
    for row in rows:
        assert int(row["steps"]) >= 20_000
        assert row["exact: reward"] != row["own: reward"]  # other numbers of episodes
    record = json.loads((made[0] / "runs" / "push" / "varied" / "2" / "policy.json").read_text())
    assert record["settings"]["training"] == {"horizon": 30}
    assert record["env_kwargs"] == {"transmission": "none"}
    reward = samples(rows, "push", "none", "own: reward")
    assert reward.tolist() == [float(row["own: reward"]) for row in rows if row["arm"] == "none"]


def test_the_same_command_makes_what_is_missing(made, trainings):
    """A missing row is evaluated again from the policy; a missing policy is trained again, to the same bits."""
    folder, argv = made
    text = (folder / "toy.csv").read_text()
    assert main(argv) == 0
    assert not trainings
    lines = text.splitlines(keepends=True)
    (folder / "toy.csv").write_text("".join(lines[:-1]))
    assert main(argv) == 0
    assert (folder / "toy.csv").read_text() == text
    assert not trainings
    (folder / "runs" / "push" / "varied" / "2" / "policy.npz").unlink()
    (folder / "toy.csv").write_text("".join(lines[:-1]))
    assert main(argv) == 0
    assert trainings == [("none", 2, None)]
    again = rows_of(folder)[-1]
    (folder / "toy.csv").write_text(text)
    assert again | {"processor [s]": ""} == rows_of(folder)[-1] | {"processor [s]": ""}


def test_a_study_that_runs_out_of_time_goes_on(made, trainings, tmp_path, capsys):
    study = tmp_path / "toy.yaml"
    study.write_text(json.dumps(TOY | {"seeds": [1], "tasks": {"push": TRIAL | {"steps": 150_000}}}))
    argv = [str(study), str(tmp_path / "toy.csv"), "--runs", str(tmp_path)]
    assert main([*argv, "--minutes", "0.001"]) == 130
    assert "stopped with 0 runs done" in capsys.readouterr().err
    assert not (tmp_path / "toy.csv").exists()
    assert main(argv) == 0
    assert trainings[1] == ("exact", 1, tmp_path / "push" / "exact" / "1" / "policy.npz")
    assert [row["arm"] for row in rows_of(tmp_path)] == ["exact", "none", "varied"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"arms": {"exact": {"env_args": {}, "training": {}}}}, "arms: exact: turn: expected env_args, training, turn"),
        ({"more": 1}, "more: expected"),
        ({"tasks": {"push": TRIAL | {"metrics": ["velocity_error", "another"]}}}, "has other columns than the study"),
    ],
)
def test_a_study_that_cannot_be_is_refused_in_one_line(made, tmp_path, capsys, change, said):
    (tmp_path / "other.yaml").write_text(json.dumps(TOY | change))
    assert main([str(tmp_path / "other.yaml"), made[1][1]]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error


def test_tables_and_picture_show_what_the_rows_say(made, tmp_path, capsys):
    folder, argv = made
    assert main([*argv[:2], "--tables", "--picture", str(tmp_path / "toy.png")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("6 of 6 runs")
    assert "open: 2 of at least 5 seeds" in text
    assert (tmp_path / "toy.png").read_bytes()[:4] == b"\x89PNG"
    study = read_study(folder / "toy.yaml")
    rows = rows_of(folder)
    exact, none = (samples(rows, "push", arm, "exact: velocity_error") for arm in ("exact", "none"))
    line = next(row for row in losses(study, rows) if row[1] == "none")
    wanted = 1 - interquartile_mean(none) / interquartile_mean(exact)
    assert line[3].startswith(f"{wanted:.2%} [")
    drawn = points(study, rows)["push: velocity error"]
    assert drawn["none"]["exact"] == none.tolist()
    assert list(drawn) == ["exact", "varied", "none"]


def test_a_loss_is_a_share_of_the_first_arm_and_is_answered_as_the_protocol_says():
    good, bad = np.array([4.0, 4.1, 3.9, 4.0, 4.0, 4.05]), np.array([3.0, 3.1, 2.9, 3.0, 3.0, 3.05])
    found, low, high = loss(good, bad)
    assert found == pytest.approx(0.25, abs=0.01)
    assert 0.2 < low < found < high < 0.3
    clear, none, wide = (found, low, high), loss(good, good), (0.05, -0.02, 0.1)
    assert answer([clear, clear], 6) == "yes"
    assert answer([none, none], 6) == "no"
    assert answer([clear, none], 6) == answer([wide, wide], 6) == "not known"
    assert answer([clear], 4) == "open: 4 of at least 5 seeds"


def test_the_shipped_study_trains_in_registered_environments():
    study = read_study(Path(study_file.__file__).parent / "studies" / "policies.yaml")
    assert {task.env for task in study.tasks.values()} <= set(ce_gym.environment_ids())
