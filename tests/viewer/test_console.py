"""Progress: a bar on a terminal, otherwise no output."""

from __future__ import annotations

import sys

import pytest

from ce_gym.console import progress


@pytest.mark.parametrize("has_tqdm", [True, False])
@pytest.mark.parametrize("terminal", [True, False])
def test_a_bar_is_shown_on_a_terminal_with_tqdm(
    terminal: bool, has_tqdm: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if has_tqdm:
        pytest.importorskip("tqdm")
    else:
        monkeypatch.setitem(sys.modules, "tqdm", None)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    assert list(progress(range(3), "rounds")) == [0, 1, 2]
    assert ("rounds" in capsys.readouterr().err) == (terminal and has_tqdm)
