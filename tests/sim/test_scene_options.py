"""Scene options: one class for simulators and tasks, with every field described and checked."""

from __future__ import annotations

import copy
import inspect
import pickle
import re
from dataclasses import fields, replace

import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym import Model, SceneOptions, Simulator
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.envs.task.tasks import VELOCITY, Task
from ce_gym.sim.scene import resolve_scene

NAMES = [field.name for field in fields(SceneOptions)]


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


@pytest.mark.parametrize("name", NAMES)
def test_every_option_is_described_and_checked(name: str):
    assert re.search(rf"^    {name}: ", inspect.getdoc(SceneOptions) or "", re.MULTILINE)
    with pytest.raises(ValueError, match=rf"^{name}=\(1\+2j\); expected [^\n]*$"):
        SceneOptions(**{name: 1 + 2j})
    with pytest.raises(ValueError, match=rf"^{name}=\(1\+2j\); expected [^\n]*$"):
        replace(VELOCITY, **{name: 1 + 2j})


def test_every_field_of_a_task_is_checked():
    assert [f.name for f in fields(Task) if "check" not in f.metadata] == ["rewards"]


def test_keywords_replace_fields_of_the_scene(model: Model):
    scene = SceneOptions(friction="secant", retry=2, dt=0.002)
    sims = [
        Simulator(model, 2, scene=scene, contacts=["front"]),
        Simulator(model, 2, 0.002, friction="secant", retry=2, contacts=("front",)),
        Simulator(model, 2, scene=replace(VELOCITY, friction="secant", retry=2, dt=0.002), contacts=("front",)),
    ]
    for sim in sims:
        assert sim.scene == replace(scene, contacts=("front",))
        assert sim.options == sims[0].options
        assert sim.dt == 0.002
    for copied in (copy.deepcopy(sims[0]), pickle.loads(pickle.dumps(sims[0]))):
        assert (copied.scene, copied.options) == (sims[0].scene, sims[0].options)


def test_a_task_passes_its_scene_options_on():
    task = replace(VELOCITY, normal_law="kelvin_voigt", retry=1, friction="secant")
    options = resolve_scene(task, Model("mini_cheetah"), None, "position")
    assert isinstance(options, StepOptions)
    assert (options.normal_law, options.retry, options.friction) == ("kelvin_voigt", 1, "secant")


def test_numbers_that_kernels_read_are_no_constants(model: Model):
    options = resolve_scene(SceneOptions(method="adaptive", tolerance=1e-4, dt=0.01), model, None, "position")
    assert options.dt is None
    assert options.tolerance is None


def test_arguments_that_do_not_exist(model: Model):
    with pytest.raises(TypeError, match=r"^unexpected keyword argument 'fricton'; .* mean 'friction'\?\)$"):
        Simulator(model, fricton="secant")
    with pytest.raises(ValueError, match=r"^unexpected keyword argument 'output'; .* mean 'outputs'\?\)$"):
        Simulator(model, output=())
    with pytest.raises(ValueError, match=r"^scene='flat'; expected SceneOptions or None$"):
        Simulator(model, scene="flat")  # type: ignore[arg-type]
    assert ce_gym.SceneOptions is SceneOptions
