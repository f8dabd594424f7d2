"""Examples for other libraries run, shortened, and are as short as promised."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "train" / "examples"

EXAMPLES = {
    "cleanrl_ppo.py": ("torch", "4_000_000", "30_000"),
    "rsl_rl_ppo.py": ("rsl_rl", "4_000_000", "30_000"),
    "sbx_ppo.py": ("sbx", "1_000_000", "8192"),
    "tianshou_ppo.py": ("tianshou", "max_epochs=250", "max_epochs=1"),
    "torchrl_ppo.py": ("torchrl", "1_000_000", "8192"),
}
"""Package that an example needs, its length of training, and another length."""


def test_examples_are_short_and_tested():
    files = sorted(FOLDER.glob("*.py"))
    assert [file.name for file in files] == sorted(EXAMPLES)
    assert all(len(file.read_text(encoding="utf-8").splitlines()) <= 40 for file in files)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name, tmp_path):
    package, length, short = EXAMPLES[name]
    pytest.importorskip(package)
    source = (FOLDER / name).read_text(encoding="utf-8")
    assert source.count(length) == 1
    command, one_thread = [sys.executable, "-c", source.replace(length, short)], {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, cwd=tmp_path, env=one_thread, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    if name == "cleanrl_ppo.py":
        assert result.stdout.count("reward per step") == 30_000 // (24 * 512)
    if name == "rsl_rl_ppo.py":
        assert (tmp_path / "runs" / "rsl_rl" / "model_1.pt").exists()
