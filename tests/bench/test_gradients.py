"""What the benchmark of gradients says of functions whose gradients are known, and its smallest run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ce_gym.bench import __main__ as command
from ce_gym.bench.accuracy import gradients

X = gradients.SIGMA * np.linspace(-4, 4, 4001)


def test_a_smooth_function_has_no_bias():
    value, slope = np.sin(10 * X)[None], 10 * np.cos(10 * X)[None]
    bias, scatter, differences = gradients.judged(X, value, slope)
    assert bias < 1e-3  # what is beyond four widths
    mean, square = np.exp(-0.125), (1 + np.exp(-0.5)) / 2  # of the cosine, and of its square
    np.testing.assert_allclose(scatter, np.sqrt(square - mean**2) / mean, rtol=1e-2)
    assert differences > 2 * scatter


def test_a_jump_is_a_bias_and_no_scatter():
    value, slope = (X > 0).astype(float)[None] + 3 * X[None], np.full((1, len(X)), 3.0)
    bias, scatter, _ = gradients.judged(X, value, slope)
    jump = 1 / np.sqrt(2 * np.pi) / gradients.SIGMA  # the slope of a smoothed step
    np.testing.assert_allclose(bias, jump / (jump + 3.0), rtol=2e-3)
    assert scatter < 1e-6


def test_the_smallest_run(tmp_path: Path, monkeypatch, capsys):
    for name, few in (("STARTS", 2), ("POINTS", 33), ("CASES", (gradients.Case(horizon=0.05),))):
        monkeypatch.setattr(gradients, name, few)
    monkeypatch.setattr(gradients, "DRAWN", ("horizon 0.05",))
    assert command.main(["gradients", "--plot", str(tmp_path / "gradients.png")]) == 0
    assert "bias" in capsys.readouterr().out
    assert (tmp_path / "gradients.png").stat().st_size > 1000
