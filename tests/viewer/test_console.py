"""Progress is for people: on a terminal a bar, elsewhere nothing."""

from __future__ import annotations

import sys

import pytest

from ce_gym.viewer.console import shown


def test_nothing_is_said_where_nobody_looks(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(shown({"a": 1, "b": 2}.items(), "letters")) == [("a", 1), ("b", 2)]
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_how_far_it_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(shown(range(3), "rounds")) == [0, 1, 2]
    assert "rounds" in capsys.readouterr().err


def test_no_bar_without_tqdm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert list(shown(range(3), "rounds")) == [0, 1, 2]
