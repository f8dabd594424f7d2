"""Range scans against a ray caster of its own, on a field and on flat ground, with and without errors of the sensor."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.terrain_tiles import make_field

N, REACH = 24, 0.6
SENSOR = {"position": [0.1, 0.02, 0.05], "rotation": [0.1, 0.6, -0.2], "rays": [3, 5], "view": [0.8, 1.4]}
SENSOR |= {"reach": REACH, "steps": 12}


def cast(height: Any, start: Any, direction: Any, reach: float = REACH) -> float:
    """First place in the ground along a ray, by steps of half a millimetre and bisection."""
    distances = np.arange(0, reach, 5e-4)

    def above(t):
        x, y, z = start[:, None] + direction[:, None] * np.atleast_1d(t)
        return z - height(x, y)

    into = np.flatnonzero(above(distances) <= 0)
    if not into.size:
        return reach
    if into[0] == 0:
        return 0.0
    low, high = distances[into[0] - 1], distances[into[0]]
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if above(middle)[0] <= 0 else (middle, high)
    return float(low + high) / 2


def turned(w, x, y, z):
    """Matrix of a quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rays(pattern: str) -> np.ndarray:
    """Directions in the link's frame, rows from the top and columns from the left, by products of quaternions."""

    def product(a, b):
        w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
        return np.array([w, *v])

    roll, pitch, yaw = (
        np.array([np.cos(a / 2), *np.sin(a / 2) * np.eye(3)[i]]) for i, a in enumerate([0.1, 0.6, -0.2])
    )
    link = turned(*product(yaw, product(pitch, roll)))
    seen = []
    for up in (0.4, 0.0, -0.4):
        for left in (0.7, 0.35, 0.0, -0.35, -0.7):
            if pattern == "camera":
                share = left / 0.7, up / 0.4
                ray = np.array([1.0, share[0] * np.tan(0.7), share[1] * np.tan(0.4)])
            else:
                ray = np.array([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)])
            seen.append(link @ ray / np.linalg.norm(ray))
    return np.array(seen)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "pattern"), [("rough", "lidar"), ("flat", "camera")])
def test_readings_are_those_of_a_ray_caster(kind, pattern):
    """The critic's within a millimetre; the policy's drift and are lost."""
    terrain = {"kind": "rough", "amplitude": 0.15, "curriculum": False} if kind == "rough" else "flat"
    envs: Any = gymnasium.make_vec(
        "ce_gym/MiniCheetahVelocity-v0",
        robot=TRIPOD,
        num_envs=N,
        terrain=terrain,
        observations={"range_scan": {**SENSOR, "pattern": pattern, "drift": 0.05, "dropout": 0.2}},
        critic=["base_height"],
        obs_mode="dict",
    ).unwrapped
    height = make_field(envs.batch.program.task.terrain).at if kind == "rough" else None
    observation, _ = envs.reset(seed=0)
    for _ in range(3):
        observation, *_ = envs.step(envs.action_space.sample())
    q, directions = envs.state()["q"].astype(float), rays(pattern)

    def ground(x, y):
        return height(x, y)[..., 0] if height else np.zeros_like(x)

    expected = np.array(
        [
            [cast(ground, pose[:3] + turn @ SENSOR["position"], turn @ ray) for ray in directions]
            for pose, turn in zip(q, [turned(*pose[3:7]) for pose in q], strict=True)
        ]
    )
    assert 0.1 < (expected == REACH).mean() < 0.9
    exact, found = observation["critic"][:, :15], observation["policy"]
    error = np.abs(exact - expected)
    assert np.median(error) < 1e-6
    assert (error < 1e-3).mean() > 0.95, "but for rays that graze the top of a hill"
    drift = 0.05 * envs.batch.rows("observation_range_scan_offset")
    drifting = np.where(exact < REACH, np.clip(exact + drift, 0, REACH), REACH)
    lost = (found == REACH) & (drifting < REACH - 1e-6)
    assert lost.mean() == pytest.approx(0.2 * (exact < REACH).mean(), abs=0.07)
    np.testing.assert_allclose(found[~lost], drifting[~lost], atol=1e-6)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"rays": [3, 0]}, r"rays=\[3, 0\]; expected two whole numbers"),
        ({"rays": [50, 50]}, r"rays=\[50, 50\]; expected at most 4000"),
        ({"view": [1.0]}, r"view=\[1.0\]; expected two angles"),
        ({"pattern": "sonar"}, "pattern='sonar'; expected 'lidar' or 'camera'"),
        ({"reach": 0.0}, "reach=0.0; expected a length"),
        ({"position": [0, 0]}, r"position=\[0, 0\]; expected three numbers"),
        ({"link": "tail"}, "link='tail'; expected one of"),
        ({"dropout": 1.0}, "dropout=1.0; expected a share"),
        ({"steps": 0}, "steps=0; expected a whole number"),
    ],
)
def test_bad_parameters(parameters: dict, message: str):
    with pytest.raises(ValueError, match=f"observation term 'range_scan': {message}") as caught:
        make_program(TRIPOD, "velocity", observations={"range_scan": parameters})
    assert "\n" not in str(caught.value)
