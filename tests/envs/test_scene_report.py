"""The scene report: its lines add up, and what it says of a feature is what happens when the feature is there."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.__main__ import main
from ce_gym.diagnostics.scene import SceneReport, SubStep, as_text, count_instructions, layers
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.plan import MOVED
from ce_gym.dynamics.laws.scene_laws import iterate_size
from ce_gym.dynamics.stepping.conservation import balance_size
from ce_gym.dynamics.stepping.trace import conserve_function, iteration_function, step_function
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.task.tasks import VELOCITY
from ce_gym.model.mechanism import Mechanism

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

ENVIRONMENT = "ce_gym/MiniCheetahVelocity-v0"
OUTPUTS = ("torque", MOVED)
"""Of a sub-step that is one function."""
AROUND = ("begin", "conserve", "accept", "copy")
"""Calls around the physics of a sub-step."""


@pytest.fixture(scope="module")
def report() -> SceneReport:
    return count_instructions(ENVIRONMENT, robot=TRIPOD)


def always(program: TaskProgram) -> dict[str, int]:
    """Instructions of the functions of the environment's kernel, by name; "assign" resets the iterate."""
    calls = program.step_program().calls
    counts = {call.function.name(): call.function.n_instructions() for call in calls}
    return counts | {"assign": next(c.function.n_instructions() for c in calls if c.outputs == ("iterate",))}


def test_lines_add_up_to_the_kernel(report: SceneReport):
    """The calls of the very program that an environment is compiled from."""
    counts, n = always(report.program), report.program.task.n_substeps
    assert report.sub_step == sum(counts[name] for name in (*AROUND, "iteration", "assign"))
    assert report.env_step == n * report.sub_step + counts["act"] + counts["evaluate"]
    assert sum(report.groups.values()) == counts["act"] + counts["evaluate"]
    assert {item.name: item.instructions for item in report.sometimes} == {
        "another iteration of a sub-step": counts["iteration"],
        "a sub-step in parts": counts["subdivide"],
        "reset": report.program.reset_program().calls[0].function.n_instructions(),
    }


def test_the_report_names_the_solver(report: SceneReport):
    assert "Accelerations are solved by elimination in joint space" in as_text(report)
    assert "Accelerations are solved by CE-ABA." in as_text(count_instructions("ce_gym/MitHumanoidStand-v0"))


def test_lines_add_up_whatever_a_task_asks_for():
    """Late actions, randomised figures, noise, history, pushes, a critic, forces for recording, limited motors."""
    report = count_instructions(
        ENVIRONMENT, robot=TRIPOD, latency=(0, 2), randomise={"friction": (0.3, 1.0)}, noise={"joint_positions": 0.1},
        history=2, push_period=1.0, heading=True, critic=("feet_in_contact",), contact_forces=True, motors="limited",
        friction="secant",
    )  # fmt: skip
    counts, n = always(report.program), report.program.task.n_substeps
    assert report.sub_step == sum(counts[name] for name in (*AROUND, "iteration", "assign"))
    once = counts["act"] + counts["evaluate"] + n * counts["arrive"] + counts["arrived"]
    assert report.env_step == n * report.sub_step + once
    layers_there = {item.name: item.instructions for item in report.layers}
    assert layers_there["limited motors"] > 0
    assert layers_there["parameters"] == 0, "a constant has become an input, nothing else"
    assert {"late actions", "critic", "noise and history"} <= report.groups.keys()
    assert "motors" not in report.unused
    assert "secant" not in report.unused["friction"]


CHANGES = {
    "pairs of links, where they are near": {"self_collisions": [["HR_knee_link", "HL_knee_link"]]},
    "sampled control": {"control_period": 0.01},
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "change"), CHANGES.items())
def test_what_a_scene_is_asked_for_has_a_line_and_sums_add_up(name: str, change: dict):
    report = count_instructions("ce_gym/MiniCheetahVelocity-v0", **change)
    whole = SubStep(report.program.model, report.program.options, ("torque",))
    assert report.sub_step == whole.instructions
    assert name in {item.name for item in report.layers}


def test_every_term_of_the_task_has_a_line(report: SceneReport):
    task = report.program.task
    terms = [item.name for item in report.once[2:]]
    assert terms == [*task.terminations, *task.metrics, *task.rewards, *task.observations]
    assert all(item.instructions > 0 for item in report.once)
    assert "joint_limits" in report.unused["rewards"]
    assert "feet_in_contact" in report.unused["observations"]
    assert not any(item.name in report.unused.get(item.group, ()) for item in report.once)


def test_layers_are_what_is_compiled_in(report: SceneReport):
    names = [item.name for item in report.layers]
    assert names[:3] == ["kinematics", "inertias and accelerations", "integration and checks"]
    assert {"rotors", "contact", "joint stops", "outputs"} <= set(names)
    assert not {"limited motors", "ground field", "parameters", "method"} & set(names), "they are left out"
    assert all(item.instructions > 0 for item in report.layers)
    rotors = next(item.instructions for item in report.layers if item.name == "rotors")
    assert 0 < rotors < 0.02 * report.sub_step


LAYERS = {
    "parameters": {"parameters": ("gravity", "com_shift:plate")},
    "limited motors": {"motors": "limited"},
    "ground field": {"ground": "field"},
}


def stage(mechanism: Mechanism, options: StepOptions) -> int:
    """Instructions of an iteration, of the zeros it starts from, and of the velocities after it."""
    iteration = iteration_function(mechanism, options, ("torque",), culls=True, conserves=False)
    functions = iteration, conserve_function(mechanism, options)
    return sum(function.n_instructions() for function in functions) + iterate_size(mechanism, options)


@pytest.mark.parametrize(("name", "change"), LAYERS.items())
def test_a_feature_costs_what_it_adds(report: SceneReport, name: str, change: dict):
    mechanism, options = report.program.model.mechanism, report.program.options
    without, with_it = (stage(mechanism, o) for o in (options, replace(options, **change)))
    whole = SubStep(report.program.model, replace(options, **change), ("torque",))
    added = whole.instructions - report.sub_step
    assert added > with_it - without > 0 if name == "ground field" else added == with_it - without > 0
    assert name in dict(layers(whole))


def test_methods_and_friction_count_every_call(report: SceneReport):
    """Alternatives change which calls there are: the combination of stages goes where none iterates."""
    mechanism, options = report.program.model.mechanism, report.program.options
    counts, balance = always(report.program), balance_size(mechanism)
    around = sum(counts[name] for name in AROUND if name != "conserve") - 2 * balance  # a method without stages

    def total(**change: str) -> int:
        return SubStep(report.program.model, replace(options, **change), ("torque",)).instructions

    explicit = step_function(mechanism, replace(options, method="rk4"), OUTPUTS).n_instructions()
    assert total(method="rk4") == explicit + around
    tangent, secant = (stage(mechanism, o) for o in (options, replace(options, friction="secant")))
    assert total(friction="secant") - report.sub_step == secant - tangent < 0


def test_a_term_costs_what_it_adds_when_it_is_there(report: SceneReport):
    model, before = report.program.model, always(report.program)["evaluate"]
    for field, term in (("rewards", "joint_limits"), ("observations", "feet_in_contact")):
        more = {**VELOCITY.rewards, term: 0.5} if field == "rewards" else (*VELOCITY.observations, term)
        assert always(TaskProgram(model, replace(VELOCITY, **{field: more})))["evaluate"] > before
        (line,) = (i for i in count_instructions(ENVIRONMENT, robot=TRIPOD, **{field: more}).once if i.name == term)
        assert line.instructions > 0


def test_what_is_enabled_is_a_layer(report: SceneReport):
    program = report.program
    options = replace(program.options, contacts=(), motors="limited", parameters=("friction", "kp"), method="rk4")
    whole = SubStep(Model(TRIPOD, "none"), options, ("torque",))
    running = dict(layers(whole))
    around = sum(call.function.n_instructions() for call in whole.calls if call.function.name() in AROUND)
    assert running["outputs"] == step_function(whole.model.mechanism, options, OUTPUTS).n_instructions() + around
    assert running["method"] > 1.5 * running["limited motors"] > 1.5 * running["joint stops"]
    assert "rotors" not in running, "this level has none"


def test_text_holds_the_figures(report: SceneReport):
    text = as_text(report)
    for number in (report.sub_step, report.env_step, report.groups["rewards"]):
        assert f" {number}\n" in text
    assert "  motors: limited\n" in text
    assert max(map(len, text.splitlines())) <= 120


def test_command(monkeypatch):
    asked = []
    monkeypatch.setattr("ce_gym.diagnostics.scene.scene_report", lambda *a, **k: asked.append((a, k)) or "report")
    assert main(["inspect", ENVIRONMENT]) == 0
    assert main(["inspect", f"ce_gym:{ENVIRONMENT}"]) == 0
    assert asked == 2 * [((ENVIRONMENT,), {})]


@pytest.mark.parametrize("name", ["ce_gym/NoSuchRobot-v0", "no_such_module:Walk-v0", "ce_gym:NoSuchRobot-v0"])
def test_command_refuses_what_is_not_there(name: str, capsys):
    assert main(["inspect", name]) == 2
    error = capsys.readouterr().err
    assert error.startswith("ce_gym: environment ")
    module, _, env_id = name.rpartition(":")
    assert (module if module == "no_such_module" else f"{env_id!r} is not registered; `python -m ce_gym list`") in error
    assert error.count("environment ") == error.count("\n") == 1


def test_only_environments_of_a_robot_and_a_task():
    assert "CartPole-v1" in gymnasium.registry
    with pytest.raises(ValueError, match=r"'CartPole-v1': made with .*; expected robot and task"):
        ce_gym.scene_report("CartPole-v1")


def test_ids_that_somebody_registered_and_arguments_are_reported(report: SceneReport, monkeypatch):
    """What an id leaves out is as in the environment; arguments that change no kernel change no figure."""
    kwargs = {"robot": TRIPOD, "task": "velocity", "num_threads": 1}
    spec = gymnasium.envs.registration.EnvSpec("my/Dog-v0", entry_point="ce_gym.envs.single:LeggedEnv", kwargs=kwargs)
    monkeypatch.setitem(gymnasium.registry, "my/Dog-v0", spec)
    assert count_instructions("my/Dog-v0", obs_mode="dict").env_step == report.env_step
    assert main(["inspect", "my/Dog-v0", "--env-arg", "terain=stairs"]) == 2
