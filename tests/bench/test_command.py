"""The command line: lists every benchmark, refuses unknown names, prints and writes reports."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.measure.report import Report


def test_without_a_name_it_lists_every_benchmark():
    finished = subprocess.run([sys.executable, "-m", "ce_gym.bench"], capture_output=True, text=True, check=True)
    for name in command.BENCHMARKS:
        assert f"\n  {name} " in finished.stdout
        assert len(command.summary(name)) > 20


def test_an_unknown_name_is_one_line(capsys):
    assert command.main(["sped"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_is_not_installed_is_one_line():
    code = "import sys; sys.modules['mujoco'] = None; from ce_gym.bench.__main__ import main; sys.exit(main(['speed']))"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert finished.returncode == 2
    assert finished.stderr == (
        'ce_gym.bench: speed needs mujoco, which is not installed: pip install "ce_gym[bench]"\n'
    )


@pytest.mark.parametrize("name", command.BENCHMARKS)
def test_every_benchmark_has_help(name, capsys):
    pytest.importorskip("mujoco")
    with pytest.raises(SystemExit) as caught:
        command.main([name, "--help"])
    assert caught.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_report_is_printed_and_written(tmp_path, capsys):
    file = tmp_path / "tracking.json"
    assert command.main(["tracking", "--json", str(file)]) == 0
    assert "knee_link" in capsys.readouterr().out
    written = json.loads(file.read_text())
    assert written["machine"]["cores"]
    assert [r["met"] for r in written["requirements"]] == [True, True]


@pytest.mark.parametrize("separator", [" ", "="])
def test_the_report_has_the_command_without_its_own_file(separator, tmp_path, monkeypatch, capsys):
    benchmark = SimpleNamespace(
        add_arguments=lambda parser: parser.add_argument("--robot"), run=lambda arguments: Report("tracking")
    )
    monkeypatch.setattr(command, "load", lambda name: benchmark)
    file = tmp_path / "report.json"
    assert command.main(["tracking", *f"--json{separator}{file}".split(" "), "--robot", "tello"]) == 0
    assert json.loads(file.read_text())["command"] == "python -m ce_gym.bench tracking --robot tello"
