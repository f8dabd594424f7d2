"""The table of how long learning takes: what a row has, and that rows are made once."""

import csv

import pytest
from point_mass import ID
from table import COLUMNS, main, times

ARGUMENTS = ["--env", ID, "--threads", "1", "--episodes", "4", "--set", "steps=6000", "num_envs=64", "rollout=16"]
ARGUMENTS += ["hidden=[16]", "epochs=4", "minibatches=2", "learning_rate=1e-2", "target_kl=0", "gamma=0.9"]


def test_the_first_policy_that_is_good_enough_counts():
    judged = [
        {"forward_error": error, "wall": wall, "processor": 2 * wall}
        for error, wall in ((0.3, 1.0), (0.1, 2.0), (0.2, 3.0), (0.07, 4.0))
    ]
    assert times(judged) == {"wall_to_0.1": 2.0, "processor_to_0.1": 4.0, "wall_to_0.06": "", "processor_to_0.06": ""}


def test_rows_that_are_there_are_not_made_again(tmp_path, capsys):
    file = tmp_path / "table.csv"
    words = [*ARGUMENTS, "--runs", str(tmp_path / "runs"), "--out", str(file)]
    assert main([*words, "--learners", "fast_ppo", "--seeds", "3"]) == 0
    first = file.read_text()
    assert main([*words, "--learners", "fast_ppo", "ppo", "--seeds", "3"]) == 0
    assert file.read_text().startswith(first)
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [(row["learner"], row["seed"]) for row in rows] == [("fast_ppo", "3"), ("ppo", "3")]
    for row in rows:
        assert sum(float(row[name]) for name in ("physics", "policy", "learning")) == pytest.approx(1, abs=0.01)
        assert float(row["processor"]) >= 0  # in tenths of a second, which a run so short may not take
        assert int(row["steps"]) >= 6000
    assert f"| {ID} | fast_ppo | 1       | 1     |" in capsys.readouterr().out


def test_another_table_is_refused(tmp_path, capsys):
    file = tmp_path / "table.csv"
    file.write_text("a,b\n1,2\n")
    assert main([*ARGUMENTS, "--out", str(file)]) == 2
    assert f"expected the columns {COLUMNS[0]}" in capsys.readouterr().err
