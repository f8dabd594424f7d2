"""The reward that keeps legs from crossing, against the places of contacts by another program."""

import gymnasium
import numpy as np
import pytest

import ce_gym  # noqa: F401  (registers the environments)

LEAST = 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sides"), [("MitHumanoid", [(1, 0)]), ("MiniCheetah", [(1, 0), (3, 2), (1, 2), (3, 0)])]
)
def test_shortfall_between_left_and_right(name: str, sides: list[tuple[int, int]]):
    """`sides` are left and right feet, in the order of the robot's contacts."""
    options = {"rewards": {"feet_distance": {"weight": 1.0, "least": LEAST}}, "autoreset_mode": "SameStep"}
    envs = gymnasium.make_vec(
        f"ce_gym/{name}Velocity-v0", transmission="none", num_envs=8, max_episode_steps=20, **options
    )
    envs.reset(seed=0)
    native, rng, short = envs.unwrapped, np.random.default_rng(0), 0
    contacts = native.model.robot.contacts
    feet = list(dict.fromkeys(c.body for c in contacts if c.group == "foot"))
    for _ in range(10):
        *_, terminated, truncated, infos = envs.step(rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32))
        state, alive = native.state(), ~(terminated | truncated)
        for q, told in zip(state["q"][alive], infos["reward_terms"]["feet_distance"][alive], strict=True):
            points, _ = native.model.contact_points(q, np.zeros(native.model.nv))
            places = [np.mean([p for p, c in zip(points, contacts, strict=True) if c.body == foot], 0) for foot in feet]
            for foot, place in zip(feet, places, strict=True):
                place[2] = min(p[2] - c.radius for p, c in zip(points, contacts, strict=True) if c.body == foot)
            w, x, y, z = q[3:7]
            across = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
            apart = [max(0.0, LEAST - across @ (places[i] - places[j])) for i, j in sides]
            assert told / native.policy_spec()["control_dt"] == pytest.approx(
                sum(d * d for d in apart), rel=1e-9, abs=1e-12
            )
            short += any(apart)
    assert short > 5
