"""Tables in plain text, and the table of robots in particular."""

from __future__ import annotations

from ce_gym.model import load_robot, robots
from ce_gym.model.load import COLUMNS, robot_row, robot_table
from ce_gym.model.table import table_text


def test_words_to_the_left_numbers_to_the_right():
    text = table_text(("name", "n", "x"), [("a", 1, 0.5), ("long name", 1000, None)], indent="")
    assert text.splitlines() == [
        "name          n    x",
        "---------  ----  ---",
        "a             1  0.5",
        "long name  1000",
    ]


def test_figures_of_a_robot():
    row = dict(zip(COLUMNS, robot_row(load_robot("mini_cheetah")), strict=True))
    assert row == {
        "robot": "mini_cheetah",
        "base": "floating",
        "bodies": 25,
        "joints": 12,
        "rotors": 12,
        "clusters": 13,
        "mass [kg]": load_robot("mini_cheetah").total_mass,
    }


def test_every_robot_has_a_line():
    lines = robot_table().splitlines()[2:]
    assert [line.split()[0] for line in lines] == robots()
