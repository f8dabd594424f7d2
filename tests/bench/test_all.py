"""Running the benchmarks one after the other leaves a file for each, which says how to repeat it."""

import argparse
import json
from pathlib import Path

import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench import all as every


def test_a_benchmark_leaves_a_file_with_its_command_and_machine(tmp_path: Path, capsys):
    assert command.main(["all", "--out", str(tmp_path), "--only", "tracking"]) == 0
    assert "2 of 2 requirements met" in capsys.readouterr().out
    written = json.loads((tmp_path / "tracking.json").read_text())
    assert written["command"] == "python -m ce_gym.bench tracking"
    assert {"processor", "date", "numpy"} <= set(written["machine"])
    assert "commit" in written


def test_a_benchmark_that_fails_is_named_with_its_reason(tmp_path: Path):
    assert every.run_one(["sped"], tmp_path / "sped.json").startswith("skipped: ce_gym.bench: no benchmark 'sped'")


@pytest.mark.parametrize("name", every.QUICK)
def test_short_runs_have_arguments_that_exist(name: str):
    """A wrong one would be found after an hour."""
    parser = argparse.ArgumentParser(exit_on_error=False)
    command.load(name).add_arguments(parser)
    parser.parse_args(list(every.QUICK[name]))
