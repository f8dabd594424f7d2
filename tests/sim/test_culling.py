"""Contacts other than feet, and pairs of links, are skipped in tiles where none of their group is near."""

from functools import partial

import numpy as np
import pytest

import ce_gym
from ce_gym import Model, Simulator
from ce_gym.dynamics.laws.contacts import MOST, culled_groups
from ce_gym.dynamics.stepping.trace import iteration_function
from ce_gym.model import ContactSphere, Robot
from ce_gym.sim import substeps

NUM_ENVS, STEPS = 40, 60
ROUGH = ce_gym.Terrain(np.random.default_rng(1).uniform(-0.05, 0.05, (40, 40)), cell=0.1, origin=(-2.0, -2.0))
SCENES = {
    "double": ("mini_cheetah", {}),
    "links": ("mini_cheetah", {"self_collisions": "listed", "contacts": ("foot", "torso")}),
    "heights": ("mini_cheetah", {"terrain": ROUGH, "dtype": "float32"}),
    "stages": ("mini_cheetah", {"method": "extrapolated"}),
    "no feet": ("cassie", {"contacts": ("knee", "torso")}),
    "humanoid": ("mit_humanoid", {}),
}
SLOW = ("heights", "stages", "no feet", "humanoid")


def in_place_of(monkeypatch, name, replacement):
    """Replace a function of `substeps` for programs that are then made."""
    monkeypatch.setattr(substeps, name, replacement)
    key = substeps.laws_key
    monkeypatch.setattr(substeps, "laws_key", lambda *given: f"{key(*given)} with another {name}")


def falls(sim):
    """Return states and contact forces while robots fall and are thrown about, the last tile stands."""
    model, rng, n = sim.model, np.random.default_rng(0), NUM_ENVS
    q = np.tile(model.standing_q, (n, 1))
    q[:20, 3:7] = rng.normal(size=(20, 4))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    q[:-16, 2] += rng.uniform(0, 0.4, n - 16)
    v = rng.normal(size=(n, model.nv)) * 2
    v[-16:] = 0
    sim.set_state(q, v)
    base, rows = model.standing_q[-len(sim.target_names) :], []
    for _ in range(STEPS):
        target = base + rng.normal(size=(n, len(base))) * 0.3
        target[-16:] = base
        sim.step(target)
        rows.append([np.array(sim.q), np.array(sim.v), np.array(sim.contact_forces)])
    return rows


@pytest.mark.parametrize("scene", [pytest.param(x, marks=pytest.mark.slow) if x in SLOW else x for x in SCENES])
def test_skipping_a_group_leaves_every_bit(scene, monkeypatch):
    """As if each group were computed in all tiles, for robots that stand, fall, and lie beside robots that stand."""
    robot, options = SCENES[scene]
    make = partial(Simulator, Model(robot), NUM_ENVS, outputs=("contact_forces",), **options)
    skipping = falls(make())
    call = substeps.call
    in_place_of(monkeypatch, "call", lambda *given, short_if_zero=(), **more: call(*given, **more))
    whole = falls(make())
    for some, every in zip(skipping, whole, strict=True):
        for part, same in zip(some, every, strict=True):
            assert part.tobytes() == same.tobytes()


def test_culled_contacts_act_as_those_that_are_always_computed(monkeypatch):
    """Robots fall on knees and trunk as in a scene without culling, until rounding errors have grown."""
    make = partial(Simulator, Model("mini_cheetah"), NUM_ENVS, outputs=("contact_forces",))
    culled = falls(make())
    in_place_of(monkeypatch, "iteration_function", lambda *given, culls, **more: iteration_function(*given, **more))
    always = falls(make())
    for step in range(30):
        np.testing.assert_allclose(culled[step][0], always[step][0], atol=1e-7)
    names = Model("mini_cheetah").robot.contacts
    others = [i for i, contact in enumerate(names) if contact.group != "foot"]
    assert (np.array([row[2].reshape(NUM_ENVS, -1, 3)[:, others, 2] for row in culled[:30]]) > 1).sum() > 20


def test_feet_are_in_no_group_and_groups_are_few():
    robot = Model("jvrc1").robot
    names = [contact.name for contact in robot.contacts]
    groups = culled_groups(robot, names)
    assert set(groups) == {"arm", "knee", "torso"}
    assert {i for places in groups.values() for i in places} == {
        i for i, contact in enumerate(robot.contacts) if contact.group != "foot"
    }
    labels = ["foot", "a", "b", "c", "d", "e", "a"]
    renamed = [ContactSphere(f"s{i}", "base", (0.0, 0.0, 0.0), 0.0, label) for i, label in enumerate(labels)]
    robot = Robot(robot.name, robot.bodies, contacts=tuple(renamed))
    groups = culled_groups(robot, [contact.name for contact in renamed])
    assert len(groups) == MOST
    assert groups == {"a": [1, 6], "b": [2], "c": [3, 4, 5]}
