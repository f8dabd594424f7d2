"""The accuracy benchmark on short scenes: that its references agree, what it times, and what it concludes."""

import argparse
import csv
from dataclasses import replace

import numpy as np
import pytest
from casadi import DM, SX, Function

pytest.importorskip("mujoco")

import mujoco

from ce_gym import Model, Simulator
from ce_gym.bench.accuracy import benchmark as accuracy
from ce_gym.bench.accuracy import curves as accuracy_curves
from ce_gym.bench.accuracy.curves import Curve, Measured, Point, comparisons, rms_error, time_to
from ce_gym.bench.accuracy.ours import Ours
from ce_gym.bench.accuracy.peers import Family, Peer
from ce_gym.bench.accuracy.references import contact as accuracy_contact
from ce_gym.bench.accuracy.references import restated as accuracy_restated
from ce_gym.bench.accuracy.references import smooth as accuracy_references
from ce_gym.bench.accuracy.scenarios import HOLD, SCENES, Scene, Way
from ce_gym.export.mujoco_coordinates import joint_rows
from ce_gym.model.checks.collisions import colliding

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def short(name: str, holds: int) -> Scene:
    scene = SCENES[name]()
    return replace(scene, drive=scene.drive[:holds], push=None if scene.push is None else scene.push[:holds])


@pytest.mark.parametrize(
    ("name", "holds"), [("belt_leg", 5), ("tumble", 10), ("four_bar", 5), ("stiff_1e3", 3), ("elastic", 3)]
)
def test_two_codes_agree_on_smooth_scenes(name: str, holds: int):
    scene = short(name, holds)
    truth = accuracy_references.ours(scene, 40)
    assert np.abs(truth[-1] - scene.q).max() > 0.01  # it did move
    assert rms_error(scene, accuracy_references.theirs(scene, 100), truth) < 1e-8


@pytest.mark.parametrize("name", ["breakaway", "reversal"])
def test_two_codes_agree_on_a_block(name: str):
    scene = short(name, 5)
    limit = Ours(scene, Way("extrapolated"), 1).run(2000)
    assert np.abs(limit[-1] - scene.q).max() > 1e-4
    assert rms_error(scene, accuracy_contact.explicit(scene, 4000), limit) < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(("name", "holds"), [("stairs", 10), ("shanks", 10), ("biped", 5)])
def test_two_codes_agree_on_robots_that_touch(name: str, holds: int):
    """On the edge of a step, between links, and on feet behind rods and springs."""
    scene = short(name, holds)
    error = rms_error(scene, accuracy_contact.explicit(scene, 8000), Ours(scene, scene.ours[1], 1).run(1000))
    coarse = rms_error(scene, Ours(scene, scene.ours[1], 1).run(10), Ours(scene, scene.ours[1], 1).run(1000))
    assert error < 3e-5 < 10 * error + 3e-5 < coarse


@pytest.mark.slow
def test_two_codes_agree_on_a_robot_that_lands():
    scene = short("drop_3cm", 5)
    lower = replace(scene, q=scene.q - 0.03 * np.eye(len(scene.q))[2])
    limit = Ours(lower, Way("euler", friction="secant"), 1).run(8000)
    error = rms_error(lower, accuracy_contact.explicit(lower, 20_000), limit)
    coarse = rms_error(lower, Ours(lower, Way("euler", friction="secant"), 1).run(100), limit)
    assert error < 1e-5 < 10 * error + 1e-5 < coarse


def test_a_step_that_is_an_input_is_the_simulators():
    scene = short("belt_leg", 3)
    model = Model(scene.robot)
    simulator = Simulator(model, 1, HOLD / 5, control="torque", outputs=())
    simulator.set_state(scene.q, scene.v)
    for torque in scene.drive:
        simulator.step(torque, 5)
    path = Ours(scene, Way("euler"), 9).run(5)
    np.testing.assert_allclose(path[-1], simulator.q[0], rtol=1e-12, atol=1e-13)


def test_mujoco_runs_the_same_scene():
    """Rotors held stiffly: it comes to our solution, at its second order; without them it does not."""
    scene = short("belt_leg", 5)
    truth = accuracy_references.ours(scene, 40)
    stiff, armature = Family(scene, "exact", stiff=True), Family(scene, "armature", stiff=False)
    errors = [rms_error(scene, Peer(stiff, "RK4", n).run(), truth) for n in (5, 20)]
    assert errors[1] < errors[0] / 8 < 1e-4
    assert rms_error(scene, Peer(armature, "RK4", 20).run(), truth) > 100 * errors[0]
    assert stiff.tied
    assert not armature.tied


def test_stairs_restated_are_the_terrain():
    terrain, x = SCENES["stairs"]().terrain, SX.sym("x")
    heights = Function("stairs", [x], list(accuracy_restated.stairs(terrain, x)))
    places = np.linspace(0.0, 1.2, 2001)
    found = np.array([np.array(part).ravel() for part in heights(places[None])]).T
    np.testing.assert_allclose(found, terrain.at(places, 0.0)[:, :2], atol=1e-12)


def test_segments_are_nearest_where_sampling_finds_them():
    rng, shares = np.random.default_rng(0), np.linspace(0.0, 1.0, 301)
    ends = [SX.sym(name, 3) for name in "abcd"]
    nearest = Function("nearest", ends, list(accuracy_restated.nearest(*ends)))
    for _ in range(50):
        a, b, c, d = rng.normal(size=(4, 3))
        here, there = (np.array(place).ravel() for place in nearest(a, b, c, d))
        sampled = (a + shares[:, None] * (b - a))[:, None] - (c + shares[:, None] * (d - c))[None]
        assert np.linalg.norm(here - there) == pytest.approx(np.linalg.norm(sampled, axis=2).min(), abs=1e-3)
        for place, (start, end) in ((here, (a, b)), (there, (c, d))):
            share = (place - start) @ (end - start) / ((end - start) @ (end - start))
            assert -1e-9 < share < 1 + 1e-9
            np.testing.assert_allclose(place, start + share * (end - start), atol=1e-9)


def test_mujoco_has_the_stairs():
    """Seen from above, away from edges, which are round in ours and sharp in MuJoCo's boxes."""
    scene = SCENES["stairs"]()
    model = Family(scene, "armature", stiff=False).model
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0
    mujoco.mj_forward(model, data)
    for x in (-0.5, 0.1, 0.35, 0.7, 1.5):
        down = mujoco.mj_ray(
            model, data, np.array([x, 0.1, 5.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, np.zeros(1, np.int32)
        )
        assert 5.0 - down == pytest.approx(scene.terrain.at(x, 0.1)[0], abs=1e-6)


def test_mujoco_has_the_springs_of_transmissions():
    """It comes to our solution of the elastic leg with its fourth-order method, and rigid drives do not."""
    scene = short("elastic", 3)
    truth = accuracy_references.ours(scene, 40)
    springs, rigid = Family(scene, "elastic", stiff=False), Family(scene, "exact", stiff=True)
    assert not springs.tied
    assert rms_error(scene, Peer(springs, "RK4", 100).run(), truth) < 1e-8
    assert rms_error(scene, Peer(rigid, "RK4", 100).run(), truth) > 1e-5


def test_mujoco_lets_only_the_pairs_touch():
    """Legs swung inwards meet in MuJoCo as they do here: as deep, at as many places, and without friction."""
    scene = SCENES["shanks"]()
    family, model = Family(scene, "armature", stiff=False), Model(scene.robot)
    data, q = mujoco.MjData(family.model), scene.q.copy()
    for i, name in enumerate(model.joint_links):
        q[7 + i] += {"R": 0.55, "L": -0.55}[name[1]] if name.endswith("_abad_link") else 0.0
        data.qpos[joint_rows(family.model)[name][0]] = q[7 + i]
    data.qpos[:7] = q[:7]
    mujoco.mj_forward(family.model, data)
    places, turns = model.body_poses(q)
    depths = []
    for first, second in colliding(scene.robot, scene.touching):
        ends = [
            places[model.body_names.index(one.body)] + turns[model.body_names.index(one.body)] @ np.array(end)
            for one in (first, second)
            for end in (one.start, one.end)
        ]
        here, there = (np.array(place).ravel() for place in accuracy_restated.nearest(*map(DM, ends)))
        depths.append(first.radius + second.radius - np.linalg.norm(here - there))
    assert min(depths) > 1e-3
    assert data.ncon == len(depths)
    np.testing.assert_allclose(sorted(-data.contact.dist), sorted(depths), atol=1e-6)
    assert (data.contact.dim == 1).all()


def test_error_counts_a_turn_once():
    scene, turn = short("tumble", 1), 0.3
    a = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    b = np.array([[0.0, 0.0, 0.4, -np.cos(turn / 2), 0.0, -np.sin(turn / 2), 0.0]])
    assert rms_error(scene, b, a) == pytest.approx(np.sqrt((0.4**2 + turn**2) / 6))
    assert rms_error(scene, a, a) == 0.0
    assert np.isnan(rms_error(scene, np.nan * a, a))


def curve(code: str, seconds: list[float], errors: list[float]) -> Curve:
    return Curve(code, "exact", "m", tuple(Point(0.1 / s, s, e, e) for s, e in zip(seconds, errors, strict=True)))


def test_time_to_an_error():
    c = curve("ce_gym", [1.0, 10.0, 100.0], [1e-1, 1e-3, 1e-5])
    errors = [p.truth for p in c.points]
    assert time_to(c, errors, 0.5) == 1.0
    assert time_to(c, errors, 1e-4) == pytest.approx(10**1.5)
    assert time_to(c, errors, 1e-6) is None
    by_chance = [1e-1, 1e-6, 1e-3]
    assert time_to(c, by_chance, 1e-4) is None
    assert time_to(c, [np.nan, 1e-3, 1e-5], 1e-2) == 10.0


def test_comparison_ends_where_references_do():
    scene = short("tumble", 1)
    ours = curve("ce_gym", [1.0, 10.0, 100.0], [1e-1, 1e-3, 1e-5])
    theirs = curve("MuJoCo", [50.0, 500.0, 5000.0], [1e-1, 1e-3, 2e-3])
    found = comparisons(Measured(scene, 1e-6, [ours, theirs]))
    assert [f"{c.error:.0e}" for c in found] == ["1e-01", "1e-02", "1e-03", "1e-04", "1e-05"]
    assert [c.ratio for c in found[:2]] == pytest.approx([50.0, 50.0])
    assert [c.theirs for c in found[2:]] == [None, None, None]
    assert accuracy.requirement(Measured(scene, 1e-6, [ours, theirs])).met
    slow = curve("ce_gym", [10.0, 100.0, 1000.0], [1e-1, 1e-3, 1e-5])
    assert not accuracy.requirement(Measured(scene, 1e-6, [slow, theirs])).met
    lost = curve("MuJoCo", [50.0, 500.0, 5000.0], [1e1, 1e1, 1e1])
    assert accuracy.requirement(Measured(scene, 1e-6, [ours, lost])).verdict == "none"


@pytest.mark.slow
def test_single_precision_is_as_near_as_its_steps_allow():
    scene = short("drop_3cm", 10)
    double, single = (Ours(scene, Way("extrapolated", dtype=dtype), 16).run(10) for dtype in ("float64", "float32"))
    assert 0 < rms_error(scene, single, double) < 1e-5


@pytest.mark.slow
def test_writes_picture_points_and_tables(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(accuracy_curves, "PEER_LIMIT", 100)
    monkeypatch.setattr(accuracy, "QUICK_STEPS", (1, 5))
    scene = short("belt_leg", 3)
    monkeypatch.setitem(SCENES, "belt_leg", lambda: scene)
    picture, points = tmp_path / "new" / "accuracy.png", tmp_path / "accuracy.csv"
    given = argparse.Namespace(scenes=["belt_leg"], peers=["MuJoCo"], rounds=1, quick=True)
    given.picture, given.points = picture, points
    report = accuracy.run(given)
    assert picture.read_bytes().startswith(b"\x89PNG")
    with points.open() as file:
        rows = list(csv.DictReader(file))
    peers = 3 * len(accuracy_curves.INTEGRATORS)  # MuJoCo with armature, rotors and rotors held stiffly
    assert len(rows) == 2 * (4 + peers) + len(accuracy_curves.TOLERANCES)
    exact = [float(row["error against the truth"]) for row in rows if row["method"] == "rk4"]
    assert exact[1] < exact[0] / 100
    assert all(float(row["time per simulated second [s]"]) > 0 for row in rows)
    assert report.requirements[0].met


def test_which_tolerances_count_and_what_fixed_steps_take_for_the_same_error():
    points = ((0.02, 1.0, 1e-2), (0.002, 10.0, 1e-4))
    fixed = tuple(Point(dt, seconds, error, error) for dt, seconds, error in points)
    asked = ((0.1, 1e-2), (1e-3, 1e-3), (1e-6, 1e-7))  # a step of a whole hold suffices; counts; too small to tell
    adaptive = tuple(Point(tolerance, 3.0, error, error) for tolerance, error in asked)
    curves = [Curve("ce_gym", "exact", "extrapolated", fixed), Curve("ce_gym", "exact", "adaptive", adaptive)]
    (row,) = accuracy.tolerance_rows(Measured(short("tumble", 10), 1e-7, curves))
    assert row[:5] == ("tumble", 1e-3, 1e-3, 1.0, 3e6)
    assert row[5] == pytest.approx(3.0 / 10**0.5)


def test_adaptive_steps_are_the_simulators():
    scene = short("belt_leg", 3)
    batch = Ours(scene, Way("adaptive"), 9)
    paths = [batch.run(1, tolerance) for tolerance in (1e-2, 1e-4, 1e-2)]
    np.testing.assert_array_equal(paths[0], paths[2])
    simulator = Simulator(
        Model(scene.robot), 1, HOLD, control="torque", contacts=(), outputs=(), method="adaptive", tolerance=1e-4
    )
    simulator.set_state(scene.q, scene.v)
    for target, q in zip(scene.drive, paths[1], strict=True):
        simulator.step(target)
        np.testing.assert_array_equal(simulator.q[0], q)
