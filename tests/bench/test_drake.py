"""Drake as a peer of the accuracy benchmark: that its robots are ours, and what is said where it is not installed."""

import argparse
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from ce_gym import Model
from ce_gym.bench.accuracy import benchmark as accuracy
from ce_gym.bench.accuracy import drake_peer
from ce_gym.bench.accuracy.curves import rms_error
from ce_gym.bench.accuracy.references import smooth as accuracy_references
from ce_gym.bench.accuracy.scenarios import BLOCK_FRICTION, GRAVITY, HOLD, SCENES, Scene
from ce_gym.model.frames import rotation_matrix

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
needs_drake = pytest.mark.skipif(not drake_peer.available(), reason="Drake is not installed")


def short(name: str, holds: int) -> Scene:
    scene = SCENES[name]()
    return replace(scene, drive=scene.drive[:holds], push=None if scene.push is None else scene.push[:holds])


def test_is_named_as_skipped_where_it_is_not_installed(monkeypatch):
    monkeypatch.setattr(drake_peer, "available", lambda: False)
    monkeypatch.setattr(accuracy, "QUICK_STEPS", (1, 5))
    scene = short("tumble", 2)
    monkeypatch.setitem(SCENES, "tumble", lambda: scene)
    given = argparse.Namespace(scenes=["tumble"], rounds=1, quick=True, picture=None, points=None)
    for peers, named in ((["Drake"], [drake_peer.SKIPPED]), ([], [])):
        given.peers = peers
        report = accuracy.run(given)
        assert [remark for remark in report.remarks if remark.startswith("Drake")] == named
        assert not [r for r in report.requirements if "time at equal error" in r.claim]


@needs_drake
@pytest.mark.parametrize("name", ["belt_leg", "humanoid"])
def test_accelerates_as_ours_with_armature(name: str):
    from ce_gym.bench.accuracy.drake_peer.peer import Peer

    scene, rng = short(name, 1), np.random.default_rng(0)
    model = Model(scene.robot, transmission="armature")
    for _ in range(3):
        q, v = model.standing_q + 0.3 * rng.normal(size=model.nq), rng.normal(size=model.nv)
        if scene.robot.floating:
            q[3:7] /= np.linalg.norm(q[3:7])
        peer = Peer(replace(scene, q=q, v=v), "armature", "runge_kutta3", 1e-3)
        plant = peer.stated.plant
        theirs = plant.EvalTimeDerivatives(peer.of_plant).CopyToVector()[plant.num_positions() :]  # no torques yet
        order = [plant.GetJointByName(joint).velocity_start() for joint in scene.robot.independent]
        base = 6 if scene.robot.floating else 0
        ours = model.forward_dynamics(q, v, np.zeros(model.nv))
        scale = np.abs(ours).max()
        np.testing.assert_allclose(theirs[order], ours[base:], atol=1e-10 * scale)
        if base:
            R = rotation_matrix(q[3:7])
            np.testing.assert_allclose(R.T @ theirs[:3], ours[:3], atol=1e-10 * scale)
            linear = R.T @ theirs[3:6] - np.cross(v[:3], v[3:6])
            np.testing.assert_allclose(linear, ours[3:6], atol=1e-10 * scale)


@needs_drake
def test_comes_to_our_solutions():
    """Rotors as bodies with couplers and a belt, at first order; integrators with armature to that level's."""
    from ce_gym.bench.accuracy.drake_peer.peer import Peer

    scene = short("belt_leg", 5)
    truth, armature = (accuracy_references.ours(scene, 40, level) for level in ("exact", "armature"))
    coarse, fine = (rms_error(scene, Peer(scene, "exact", "lagged", HOLD / n).run(), truth) for n in (50, 200))
    assert coarse / fine == pytest.approx(4.0, rel=0.1)
    assert fine < 1e-3
    path = Peer(scene, "armature", "runge_kutta5, fixed", HOLD / 10).run()
    assert rms_error(scene, path, armature) < 1e-8
    assert rms_error(scene, path, truth) > 0.01


@needs_drake
@pytest.mark.parametrize("name", ["stiff_1e3", "tumble"])
def test_error_control_comes_to_our_solution(name: str):
    from ce_gym.bench.accuracy.drake_peer.peer import Peer

    scene = short(name, 3)
    level = scene.levels[0]
    truth = accuracy_references.ours(scene, 100, None if level == "none" else level)
    for method, accuracy_asked, error in (("runge_kutta5", 1e-8, 1e-7), ("radau3", 1e-6, 1e-5), ("cenic", 1e-6, 1e-2)):
        assert rms_error(scene, Peer(scene, level, method, accuracy_asked).run(), truth) < error, method


@needs_drake
@pytest.mark.parametrize("method", ["sap", "similar", "lagged", "tamsi", "cenic"])
def test_a_block_slides_as_far_as_coulomb_says(method: str):
    from ce_gym.bench.accuracy.drake_peer.peer import DISCRETE, Peer

    scene = SCENES["slide"]()
    path = Peer(scene, "none", method, HOLD / 20 if method in DISCRETE else 1e-5).run()
    exact = 0.5 * (2.0 - 1.0) * BLOCK_FRICTION * GRAVITY * scene.duration**2
    assert path[-1, 0] == pytest.approx(exact, rel=0.01)
    glides = HOLD / 20 * BLOCK_FRICTION * GRAVITY * scene.duration if method in ("sap", "similar") else 0.0
    assert scene.q[2] - 1e-4 < path[-1, 2] < scene.q[2] + glides + 1e-4  # contacts as stiff as ours, but see docs
