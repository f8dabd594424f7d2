"""Terms of skills against their definitions in numpy: what is gained once, how an episode ends, where it begins."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.envs.registration import environment_ids
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.skills import SKILLED, SKILLS

ID, STEPS, ROBOTS = "ce_gym/MiniCheetahStand-v0", 12, 16
START = {"height": [0.8, 1.2], "lean": [0.2, 0.9]}


@pytest.fixture(scope="module")
def flight() -> dict[str, np.ndarray]:
    """One short episode of robots that begin high up: states before and after each step, and what is reported."""
    envs = gymnasium.make_vec(
        ID,
        num_envs=ROBOTS,
        transmission="none",
        contacts=(),
        start=START,
        reset_noise={"base_velocity": 2.0},
        terminations=(),
        metrics=["apex", "turn", "stands", "longest_flight", "stood_after", "forward_speed"],
        rewards={"new_height": 2.0, "new_turn": {"weight": 1.0, "most": 0.1}, "new_distance": 1.0},
        only_positive=False,
        push_period=0.0,
        max_episode_steps=STEPS,
        autoreset_mode="SameStep",
    )
    envs.reset(seed=5)
    states = [envs.unwrapped.state()]
    for _ in range(STEPS):
        *_, infos = envs.step(np.zeros(envs.action_space.shape, np.float32))
        states.append(envs.unwrapped.state())
    return {key: np.array([state[key] for state in states[:-1]]) for key in ("q", "v")} | infos["episode_terms"]


def rotations(q: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions w, x, y, z, shape (..., 3, 3)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def test_episodes_begin_where_the_task_says(flight):
    standing = ce_gym.load_robot("mini_cheetah").pose.height
    height, lean = flight["q"][0, :, 2] - standing, np.arccos(rotations(flight["q"][0, :, 3:7])[:, 2, 2])
    for found, (low, high) in ((height, START["height"]), (lean, START["lean"])):
        assert low <= found.min() < found.max() <= high
        assert np.ptp(found) > 0.5 * (high - low)


def test_a_robot_in_the_air_falls_freely(flight):
    z = flight["q"][:, :, 2]
    np.testing.assert_allclose(np.diff(z, 2, axis=0), -9.81 * 0.02**2, atol=5e-3)  # of the base, legs move a little


def test_what_is_gained_is_paid_once(flight):
    """Sums of the terms are the best of the episode, up to the last state but one and the first after the end."""
    standing, dt = ce_gym.load_robot("mini_cheetah").pose.height, 0.02
    np.testing.assert_allclose(flight["reward/new_height"], 2.0 * flight["metrics/apex"], rtol=1e-9)
    risen = flight["q"][1:, :, 2].max(axis=0) - standing
    assert (flight["metrics/apex"] >= risen - 1e-9).all()
    falling = np.diff(flight["q"][:, :, 2], axis=0)[-1] < 0  # the last step brings nothing new
    assert falling.sum() > 3
    np.testing.assert_allclose(flight["metrics/apex"][falling], risen[falling], rtol=1e-9)
    turned = -dt * np.cumsum(flight["v"][1:, :, 1], axis=0)
    last = np.abs(flight["metrics/turn"] - turned[-1])  # one more step of at most some rad/s
    assert last.max() < 0.1
    best = np.clip(turned.max(axis=0), 0, 0.1)
    assert (flight["reward/new_turn"] >= best - 1e-9).all()
    assert flight["reward/new_turn"].max() == pytest.approx(0.1)


def test_metrics_at_the_end_are_no_means(flight):
    """The way of a flight is the sum of its steps, and is not divided by them."""
    R, v = rotations(flight["q"][1:, :, 3:7]), flight["v"][1:, :, 3:6]
    speed = np.einsum("tnij,tnj->tni", R, v)[..., :2]
    ahead = R[..., :2, 0] / np.linalg.norm(R[..., :2, 0], axis=-1, keepdims=True)
    way = 0.02 * np.cumsum(np.einsum("tni,tni->tn", speed, ahead), axis=0)
    assert np.abs(flight["metrics/longest_flight"] - np.maximum(way.max(axis=0), 0)).max() < 0.06  # one step of 3 m/s
    np.testing.assert_allclose(flight["reward/new_distance"], flight["metrics/longest_flight"], rtol=1e-9)
    np.testing.assert_array_equal(flight["metrics/stands"], 0)
    np.testing.assert_allclose(flight["metrics/stood_after"], 0.02 * STEPS)


def test_the_pitch_at_touch_down_is_that_at_the_end_of_the_longest_flight():
    """A drop, then whatever bounces come of it; flights are found in the states by contact spheres."""
    envs = gymnasium.make_vec(
        ID, num_envs=ROBOTS, transmission="none", start={"height": [0.2, 0.6], "lean": [0.1, 0.6]}, terminations=(),
        push_period=0.0, metrics=["touch_down_pitch"], max_episode_steps=40, autoreset_mode="SameStep",
    )  # fmt: skip
    envs.reset(seed=7)
    model, states = envs.unwrapped.model, []
    groups, radii = zip(*[(c.group, c.radius) for c in model.robot.contacts], strict=True)
    legs = [i for i, group in enumerate(groups) if group in ("foot", "knee")]
    for _ in range(40):
        *_, infos = envs.step(np.zeros(envs.action_space.shape, np.float32))
        states.append(envs.unwrapped.state())
    found, flights = infos["episode_terms"]["metrics/touch_down_pitch"], np.zeros(ROBOTS)
    for robot in range(ROBOTS):
        lasted, best, pitch = 0, 0, 0.0
        for state in states[:-1]:  # the last is the next episode's first
            q = state["q"][robot]
            heights = model.contact_points(q, np.zeros(model.nv))[0][legs, 2] - np.array(radii)[legs]
            if (heights > 0).all():
                lasted += 1
                continue
            if lasted > best:
                up = rotations(q[3:7])[2]
                best, pitch = lasted, abs(np.arctan2(up[0], up[2]))
            flights[robot] += lasted > 0
            lasted = 0
        assert found[robot] == pytest.approx(pitch, abs=1e-9)
    assert flights.max() > 1  # some bounce
    assert 0.05 < found.mean() < 0.6
    assert np.ptp(found) > 0.1


def states(program, **changes) -> dict[str, np.ndarray]:
    """A robot that stands still, with some of its state changed."""
    state = {name: np.zeros(size) for name, size in program.state_sizes.items()}
    return state | {"q": program.model.standing_q.copy(), "previous_action": np.zeros(program.n_actions)} | changes


def values(program, terms, state) -> dict[str, float]:
    function = program.stages.terms_function(terms)
    found = function(*[state[function.name_in(i)] for i in range(function.n_in())])
    return dict(zip(terms, np.asarray(found).ravel().tolist(), strict=True))


def test_a_standing_robot_stands_and_hops_by_the_clock():
    program = make_program(
        "mini_cheetah", "hop", transmission="none", metrics=["stands", "stood_after", "flights", "flipped"],
        rewards={"standing": {"weight": 1.0, "begin": 0.5}, "upright": 1.0, "roll": 1.0}, terminations=["other_foot"],
    )  # fmt: skip
    q = program.model.standing_q.copy()
    q[2] -= 1e-3  # feet on the ground
    late = states(program, q=q, clock=np.array([30.0]))
    rewards = values(program, program.reward_terms, late)
    assert (rewards["standing"], rewards["upright"], rewards["roll"]) == (pytest.approx(1, abs=1e-3), 1, 0)
    assert rewards["hop"] == 1  # 0.6 s are a fifth of a cycle of 0.5 s
    assert values(program, program.reward_terms, late | {"clock": np.array([10.0])})["standing"] == 0
    assert values(program, program.reward_terms, late | {"clock": np.array([45.0])})["hop"] == -1
    tilted = q.copy()
    tilted[3:5] = np.cos(0.3), np.sin(0.3)  # 0.6 rad to a side
    leaning = values(program, program.reward_terms, late | {"q": tilted})
    assert leaning["roll"] == pytest.approx(np.sin(0.6) ** 2)
    assert leaning["upright"] == pytest.approx((1 + np.cos(0.6)) / 2)
    (failed,) = values(program, program.termination_terms, late).values()
    assert failed == 1
    (failed,) = values(program, program.termination_terms, late | {"clock": np.array([10.0])}).values()
    assert failed == 0
    memory = {"metric_stood_after_since": np.array([0.3]), "metric_flights_aloft": np.ones(1)}
    found = values(program, program.metric_terms, late | memory)
    assert found == {"stands": 1, "stood_after": pytest.approx(0.3), "flights": 1, "flipped": 0}
    turned = {"metric_flipped_turned": np.array([2 * np.pi + 0.3])}
    assert values(program, program.metric_terms, late | memory | turned)["flipped"] == 1
    down = q.copy()
    down[2] *= 0.7
    found = values(program, program.metric_terms, late | memory | {"q": down})
    assert (found["stands"], found["stood_after"]) == (0, pytest.approx(0.62))


def test_ids_of_skills_are_those_of_the_robots_that_have_them():
    ids = environment_ids()
    assert set(SKILLED) == set(SKILLS)
    for skill, robots in SKILLED.items():
        assert {made["robot"] for made in ids.values() if made["task"] == skill} == set(robots)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"heigth": [0, 1]}, "start='heigth'; expected one of height, lean"),
        ({"height": [1, 0]}, r"start\['height'\]"),
        ([0, 1], r"start=\[0, 1\]; expected pairs"),
    ],
)
def test_starts_that_cannot_be(start, message):
    with pytest.raises(ValueError, match=message):
        make_program("mini_cheetah", "land", transmission="none", start=start)
