"""Windows of a log: wherever the log ends, states at their starts follow from the angles about them."""

from types import SimpleNamespace

import numpy as np
import pytest

from ce_gym.identify.log import Log
from ce_gym.identify.windows import smoothed_states, split_log


@pytest.mark.parametrize("window", [0.01, 0.02, 0.5])
@pytest.mark.parametrize("dt", [1e-4, 1e-3, 5e-3])
def test_states_of_cubics_are_exact_in_logs_of_any_length(dt: float, window: float):
    rows = 8 * (5 * max(4, round(window / dt / 5))) + round(0.03 / dt)
    for more in (2, 3, 7, 11, 20):
        t = np.arange(rows + more) * dt / ((rows + more) * dt)
        cubics = np.array([[0.1, -0.4, 0.3, 0.8], [0.0, 1.0, -2.0, 1.0]])
        angles = np.stack([np.polyval(c[::-1], t) for c in cubics], axis=1)
        speeds = np.stack([np.polyval(np.polyder(c[::-1]), t) for c in cubics], axis=1) / ((rows + more) * dt)
        log = Log(dt, (), angles[:, :0], (("angle", "a"), ("angle", "b")), angles)
        shooting = SimpleNamespace(log=log, encoders=SimpleNamespace(positions=lambda z: z))
        for windows in split_log(log, window, 0.03, 0.2):
            assert windows.rows.max() < len(t)
            for each in (windows, windows.parts()):
                states = smoothed_states(shooting, each)  # type: ignore[arg-type]
                np.testing.assert_allclose(states[:, :2], angles[each.first], atol=1e-10)
                np.testing.assert_allclose(states[:, 2:], speeds[each.first], atol=1e-6)
