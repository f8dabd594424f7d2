"""Requests of a live page and their effect on the robots, without browser and clock."""

from __future__ import annotations

import json
import random
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ce_gym.viewer import Rollout, ViewerError
from ce_gym.viewer.live.messages import REQUESTS, parsed, request_of
from ce_gym.viewer.live.pull import FREQUENCY, GRAVITY, MOST, force_responses, point_velocity, pulled
from ce_gym.viewer.live.robot import LiveRobot
from ce_gym.viewer.live.runner import Runner
from ce_gym.viewer.live.session import DROP, THROW, Session
from ce_gym.viewer.live.setup import Setup, named

POLICY = "mini_cheetah_velocity"


@pytest.fixture(scope="module")
def robot() -> LiveRobot:
    return Setup(policy=POLICY).robots()[0]


@pytest.fixture
def session(robot: LiveRobot) -> Session:
    robot.reset(0)
    robot.set_figures({"friction": 0.8, "added_mass": 0.0})
    return Session([robot])


def test_arguments_of_the_environment_are_taken(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ViewerError, match="smell"):
        Setup(policy=POLICY, kwargs={"smell": 1}).robots()
    monkeypatch.setattr("ce_gym.viewer.live.setup.LiveRobot", lambda env_id, act, **kwargs: kwargs)
    setup = named(POLICY, kwargs={"action_scale": 0.1, "transmission": "none"}, ghost="coupled")
    assert [robot["transmission"] for robot in setup.robots()] == ["none", "coupled"]
    assert [robot["action_scale"] for robot in setup.robots()] == [0.1, 0.1]
    assert setup.changed({"policy": ""}).kwargs == setup.kwargs
    assert (setup.policy, named("ce_gym/MiniCheetahVelocity-v0").env_id) == (POLICY, "ce_gym/MiniCheetahVelocity-v0")


def ask(session: Session, **message: Any) -> None:
    request_of(message)(session)


@pytest.mark.slow
def test_it_goes_where_it_is_driven(session: Session):
    ask(session, do="drive", shares=[0.5, 0, 0])
    assert session.command.tolist() == [0.5, 0, 0]
    session.advance(3.0)
    assert session.robots[0].state()[1][4 - 1] == pytest.approx(0.5, abs=0.15)
    ask(session, do="drive", shares=[0, 9, -0.5])
    assert session.command.tolist() == [0, 0.5, -0.5]


def test_forces_change_momentum_by_their_impulse(session: Session):
    """Linear momentum, and angular momentum about the base: the base's rows of `M dv`."""
    robot = session.robots[0]
    robot.write(robot.state()[0], 0.3 * np.sin(np.arange(18)))
    q, v = robot.state()
    foot, force = 3, np.array([3.0, -20.0, 7.0])
    positions, rotations = robot.model.body_poses(q)
    place = positions[foot] + [0.1, 0.0, -0.2]
    gained = (
        robot.model.mass_matrix(q) @ force_responses(robot.model, q, v, robot.model.body_names[foot], place) @ force
    )
    base = rotations[0].T
    assert gained[3:6] == pytest.approx(base @ force, rel=1e-9)
    assert gained[:3] == pytest.approx(base @ np.cross(place - q[:3], force), rel=1e-9)


def test_a_pull_is_the_spring_s_force_at_the_end_of_the_step(session: Session):
    """By the velocity that the point has then; it is the same for a point that is still where it is pulled to."""
    robot = session.robots[0]
    q, v = robot.state()
    model, dt, foot = robot.model, robot.dt, robot.model.body_names[5]
    positions, rotations = model.body_poses(q)
    point = np.array([0.0, 0.02, -0.1])
    arm = rotations[5] @ point
    target = positions[5] + arm + [0.02, 0.0, 0.05]
    after = pulled(model, q, v, dt, foot, point, target)
    velocity = point_velocity(model, q, after, 5, arm)
    K = model.total_mass * FREQUENCY**2
    force = K * (target - positions[5] - arm - dt * velocity) - 2 * K / FREQUENCY * velocity
    assert after - v == pytest.approx(dt * force_responses(model, q, v, foot, positions[5] + arm) @ force, rel=1e-6)
    gentle = pulled(model, q, v, dt, foot, point, target + [0, 0, 1e3])
    weight = (model.mass_matrix(q) @ (gentle - v) / dt)[3:6]
    assert np.linalg.norm(weight) == pytest.approx(MOST * GRAVITY * model.total_mass)


def test_it_is_dragged_towards_the_pointer_and_let_go(session: Session):
    """It hangs, sunk by its weight over the spring's stiffness, and falls."""
    robot = session.robots[0]
    place = robot.state()[0][:3]
    ask(session, do="drag", body="no such body", point=[0, 0, 0], target=[0, 0, 0])
    base = robot.model.body_names[0]
    ask(session, do="drag", body=base, point=[0, 0, 0], target=(place + [0, 0, 0.8]).tolist())
    session.advance(3.0)
    assert robot.state()[0][2] - place[2] == pytest.approx(0.8 - GRAVITY / FREQUENCY**2, abs=0.06)
    ask(session, do="release")
    session.advance(1.0)
    assert robot.state()[0][2] < 0.4


def test_a_light_leg_is_dragged_without_shaking(session: Session):
    robot = session.robots[0]
    shank = robot.model.joint_links[2]
    index = robot.model.body_names.index(shank)
    place = robot.model.body_poses(robot.state()[0])[0][index]
    ask(session, do="drag", body=shank, point=[0, 0, 0], target=(place + [0, 0, 0.3]).tolist())
    session.advance(2.0)
    heights = []
    for _ in range(25):
        session.advance(session.dt)
        heights.append(robot.model.body_poses(robot.state()[0])[0][index][2])
    assert min(heights) > place[2] + 0.03
    assert np.ptp(heights) < 0.05


def test_throw_drop_and_reset(session: Session):
    robot = session.robots[0]
    q, v = robot.state()
    ask(session, do="throw")
    world = robot.model.body_poses(q)[1][0]
    assert world @ (robot.state()[1] - v)[3:6] == pytest.approx(THROW)
    ask(session, do="drop")
    assert robot.state()[0][2] == pytest.approx(q[2] + DROP)
    assert not robot.state()[1].any()
    session.advance(1.0)
    ask(session, do="reset")
    assert robot.state()[0][2] == pytest.approx(q[2], abs=0.02)


def test_who_looks_back_goes_on_from_there_bit_for_bit(session: Session):
    session.drive([0.4, 0, 0])
    session.advance(0.5)
    ask(session, do="throw")
    at_throw = session.robots[0].state()
    session.advance(0.8)
    fallen = session.robots[0].state()
    ask(session, do="look_back", seconds=0.8)
    assert session.paused
    session.advance(5.0)
    assert session.past[1] == pytest.approx(0.8)  # time stands still
    ask(session, do="pause", on=False)
    restored = session.robots[0].state()
    assert np.array_equal(restored[0], at_throw[0])  # the throw came after the snapshot of that moment
    session.robots[0].write(*at_throw)
    session.advance(0.8)
    assert all(np.array_equal(a, b) for a, b in zip(session.robots[0].state(), fallen, strict=True))


def test_steps_pause_and_slow_motion(session: Session):
    ask(session, do="speed", speed=0.25)
    session.advance(4.0)
    assert session.time == pytest.approx(1.0)
    ask(session, do="step")
    assert session.paused
    assert session.time == pytest.approx(np.ceil(1.0 / session.dt) * session.dt + session.dt)
    frozen = session.robots[0].state()
    session.advance(1.0)
    assert np.array_equal(session.robots[0].state()[0], frozen[0])


def test_what_is_shown_between_two_steps_lies_between_them(session: Session):
    session.drive([0.8, 0, 0])
    session.advance(1.0)
    shown = []
    for _ in range(4):
        session.advance(session.dt / 4)
        shown.append(session.poses()[0])
    steps = np.diff([q[7:] for q in shown], axis=0)
    assert np.abs(steps[1:] - steps[:-1]).max() < 0.02  # no jumps [rad]
    assert all(np.linalg.norm(q[3:7]) == pytest.approx(1.0) for q in shown)


def test_only_the_last_thirty_seconds_are_kept(session: Session):
    session.advance(31.0)
    assert session.past == pytest.approx((30.0, 0.0), abs=2 * session.dt)
    ask(session, do="look_back", seconds=1000.0)
    assert session.past[1] == pytest.approx(30.0, abs=2 * session.dt)


def test_friction_and_load_are_those_of_the_physics(session: Session):
    """On ice it slips where it stood; under load it sinks into its springs."""
    robot = session.robots[0]
    ask(session, do="figure", name="added_mass", value=10.0)
    session.advance(1.0)
    loaded = robot.state()[0][2]
    ask(session, do="figure", name="added_mass", value=0.0)
    session.advance(1.0)
    assert robot.state()[0][2] > loaded + 0.01
    ask(session, do="figure", name="friction", value=0.05)
    session.throw()
    assert robot._batch.rows("parameters")[0].tolist() == pytest.approx([0.05, 0.0])
    robot.reset(1)
    assert robot._batch.rows("parameters")[0].tolist() == pytest.approx([0.05, 0.0])  # a reset draws none


INVALID = [
    {}, {"do": "explode"}, {"do": ["drive"]}, {"do": "drive"}, {"do": "drive", "shares": [0, 1]},
    {"do": "drive", "shares": [0, 1, float("nan")]}, {"do": "drive", "shares": [0, 1, True]},
    {"do": "pause", "on": 1}, {"do": "speed", "speed": 0}, {"do": "speed", "speed": "1"},
    {"do": "look_back", "seconds": float("inf")}, {"do": "drag", "body": "x", "point": [0, 0, 0]},
    {"do": "figure", "name": "ratio", "value": 1.0}, {"do": "figure", "name": "friction", "value": -1},
    {"do": "figure", "name": "friction", "value": 9.0}, {"do": "figure", "name": [], "value": 1.0},
    {"do": "figure", "name": {}, "value": 1.0}, {"do": "drive", "shares": [10**400, 0, 0]}, {"do": "throw", "up": 1},
    {"do": "drag", "body": [], "point": [0, 0, 0], "target": [0, 0, 0]}, {"do": "pause", "on": None},
    b"", b"{", b"[]", b"\xff", b"[" * 100_000,
]  # fmt: skip


@pytest.mark.parametrize("message", INVALID)
def test_invalid_messages_are_refused_in_one_line(message: dict[str, Any] | bytes):
    with pytest.raises(ValueError, match=r"expected|missing") as refused:
        parsed(message) if isinstance(message, bytes) else request_of(message)
    assert "\n" not in str(refused.value)


def test_the_page_can_send_every_request():
    script = Path(__file__).parents[2].joinpath("ce_gym/viewer/web/live.js").read_text()
    assert [name for name in REQUESTS if f'"{name}"' not in script] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "expected a policy or an environment"),
        ({"policy": POLICY, "transmission": "belt"}, "transmission='belt'; expected one of exact"),
        ({"policy": POLICY, "kwargs": {"push_period": 1.0}}, "push_period: expected another argument"),
    ],
)
def test_invalid_setups_are_refused(arguments: dict[str, Any], message: str):
    with pytest.raises(ViewerError, match=message):
        Setup(**arguments)


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with closing(Runner(Setup(policy=POLICY), tmp_path_factory.mktemp("live"))) as runner:
        yield runner


def settle(runner: Runner) -> None:
    """Process requests, wait for the background job, and use its result."""
    runner.process_requests()
    if runner._job:
        runner._job.exception()
        runner.process_requests()


def test_a_choice_goes_on_from_where_the_robot_is(runner: Runner):
    runner.receive(b'{"do": "drive", "shares": [0, 0, 1]}')
    settle(runner)
    runner.session.advance(1.0)
    before = runner.session.robots[0].state()
    runner.receive(json.dumps({"do": "choose", "policy": ""}).encode())
    settle(runner)
    assert all(np.array_equal(a, b) for a, b in zip(runner.session.robots[0].state(), before, strict=True))
    assert runner.state()["setup"]["policy"] == ""
    runner.receive(json.dumps({"do": "choose", "ghost": "exact"}).encode())
    settle(runner)
    runner.session.advance(0.5)
    poses = runner.session.poses()
    assert np.array_equal(poses[0], poses[1])  # a ghost on the same level does the same


def test_a_choice_that_fails_leaves_what_is_there(runner: Runner):
    for message in ({"policy": "../secret"}, {"terrain": "lava"}, {"shape": "x"}, {"terrain": []}, {"ghost": {}}):
        with pytest.raises(ValueError, match=r"expected (one of|'')|expected 'flat'"):
            runner.receive(json.dumps({"do": "choose", **message}).encode())
    for message in ({}, {"on": 1}, {"on": True, "folder": "/"}):
        with pytest.raises(ValueError, match="expected"):
            runner.receive(json.dumps({"do": "record", **message}).encode())
    robots = runner.session.robots
    runner._prepare_robots({"policy": "no such policy"})
    settle(runner)
    assert runner.session.robots is robots
    assert "no such policy" in runner.state()["notice"]


def test_what_is_recorded_becomes_a_page_and_rollouts(runner: Runner):
    runner.receive(b'{"do": "record", "on": true}')
    settle(runner)
    runner.session.advance(0.5)
    runner.receive(b'{"do": "record", "on": false}')
    settle(runner)
    runner._background.submit(lambda: None).result()
    page = Path(runner.state()["notice"].removeprefix("written: "))
    assert "MeshCat" in page.read_text(encoding="utf-8")
    rollout = Rollout.load(page.with_name(f"{page.stem}_exact.npz"))
    assert np.array_equal(rollout.q[-1], np.float32(runner.session.robots[0].state()[0]))


def random_value(rng: random.Random, depth: int = 0) -> Any:
    """Return a value that JSON can express."""
    numbers = [0, 1, -1, 0.5, 1e308, 10**400, -(10**30), float("nan"), float("inf"), True, False, None]
    texts = ["", "x", "trunk", "exact", "flat", "friction", "\x1b[2J", "\n", "'" * 3, "/", "..", "ä" * 500]
    kind = rng.random()
    if kind < 0.3 and depth < 3:
        return [random_value(rng, depth + 1) for _ in range(rng.choice((0, 1, 3, 3, 3, 4)))]
    if kind < 0.4 and depth < 3:
        return {rng.choice(texts): random_value(rng, depth + 1) for _ in range(rng.randrange(3))}
    return rng.choice(numbers if kind < 0.8 else texts)


def test_random_messages_are_carried_out_or_refused_in_one_line(runner: Runner):
    rng = random.Random(0)
    names = [*REQUESTS, "choose", "record", "explode"]
    entries = ["shares", "on", "speed", "seconds", "body", "point", "target", "name", "value", "ghost", "terrain", "x"]
    good: dict[str, Any] = {"shares": [1, 0, 0], "on": False, "speed": 1, "seconds": 0.1, "body": "trunk", "value": 0.5}
    good |= {"point": [0, 0, 0], "target": [0, 0, 1], "name": "friction", "ghost": "", "terrain": "flat"}
    carried_out = 0
    for _ in range(600):
        message = {"do": rng.choice(names)}
        known = list(REQUESTS[message["do"]][1]) if message["do"] in REQUESTS else entries
        for name in known if rng.random() < 0.8 else rng.sample(entries, 3):
            message[name] = good.get(name) if rng.random() < 0.7 else random_value(rng)
        body = bytearray(json.dumps(message).encode())
        if rng.random() < 0.2:
            body[rng.randrange(len(body))] = rng.randrange(256)
        refusal = ""
        try:
            runner.receive(bytes(body))
        except ValueError as error:
            refusal = str(error)
        carried_out += not refusal
        assert "\n" not in refusal
        if message["do"] == "choose":
            runner._requests = type(runner._requests)()  # without compilations
        runner.process_requests()
        runner.session.advance(0.02)
        assert all(np.isfinite(pose).all() for pose in runner.session.poses())
    assert carried_out > 100
