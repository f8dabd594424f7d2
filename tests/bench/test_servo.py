"""The benchmark of a real servo, on logs that its own models made: both simulators agree, and a fit finds them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("scipy")

from ce_gym.bench.accuracy.servo import FIGURES, Logs, as_columns, by_our_step, by_their_scheme, fit, read_logs

MADE_WITH = FIGURES | {"kt": 0.33, "R": 2.6, "friction_base": 0.005, "friction_viscous": 0.008, "q_offset": 0.02}


@pytest.fixture
def logs() -> Logs:
    """Two seconds at two gains, the motor off at the end."""
    t, n = 0.005 * np.arange(400), 2
    goals = np.repeat((np.sin(2 * t) + 0.3 * np.sin(7 * t))[:, None], n, 1)
    enabled = np.repeat((t < 1.7).astype(float)[:, None], n, 1)
    each = {"mass": np.full(n, 0.5), "length": np.full(n, 0.1), "volts": np.full(n, 7.4)}
    each["gain"] = np.array([100.0, 400.0])
    made = Logs(0.005, **each, goals=goals, angles=0 * goals, enabled=enabled)
    return replace(made, angles=by_their_scheme(made, as_columns([MADE_WITH]))[:, 0])


def test_our_step_and_the_authors_scheme_agree(logs: Logs):
    """All of M6 at the authors' step, to what is first order in it."""
    assert np.abs(by_our_step(logs, MADE_WITH) - logs.angles).mean() < 2e-3
    assert np.ptp(logs.angles) > 1.0


def test_a_fit_finds_angles_that_a_model_made(logs: Logs):
    """M1 to logs that M1 made: what it predicts, not each of its figures, of which torque and friction trade places."""
    plain = {name: 0.0 if "stribeck" in name or "load" in name else value for name, value in MADE_WITH.items()}
    plain |= {"dtheta_stribeck": 1.0, "alpha": 1.0}
    made = replace(logs, angles=by_their_scheme(logs, as_columns([plain]))[:, 0])
    found = fit(made, "m1")
    assert np.abs(by_their_scheme(made, as_columns([found]))[:, 0] - made.angles).mean() < 1e-3
    assert found["q_offset"] == pytest.approx(0.02, abs=1e-3)


def test_logs_are_read_as_they_are_processed(tmp_path: Path, logs: Logs):
    entries = [{"position": 0.1, "goal_position": 0.2, "torque_enable": True}] * 3
    log = {"mass": 0.5, "length": 0.1, "kp": 100, "vin": 7.4, "dt": 0.005, "entries": entries}
    (tmp_path / "one.json").write_text(json.dumps(log))
    (tmp_path / "two.json").write_text(json.dumps(log | {"kp": 200, "entries": entries[:2]}))
    read = read_logs(tmp_path)
    assert read.goals.tolist() == [[0.2, 0.2], [0.2, 0.2]]
    assert read.gain.tolist() == [100, 200]
    with pytest.raises(ValueError, match="no logs"):
        read_logs(tmp_path / "nothing")
