"""Terms with parameters and memory, from outside: one file and one name; what is wrong with one is said in one line."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import casadi as ca
import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.terms import registry

ID = "ce_gym/MiniCheetahVelocity-v0"
FILE = '''
import casadi as ca
import ce_gym

@ce_gym.reward
def steady_speed(s, width=0.5):
    """Keep the speed of the control step before; 1 if exact."""
    before = s.recall("speed", size=2, reset=[0.5, -0.5])
    s.keep("speed", s.base_linear_velocity[:2])
    return ca.exp(-ca.sumsqr(s.base_linear_velocity[:2] - before) / width)

@ce_gym.observation
def slow_height(s, share=0.9):
    """Height of the base, smoothed [m], shape (1,)."""
    smooth = share * s.recall("height", reset=0.25) + (1 - share) * s.base_height
    s.keep("height", smooth)
    return smooth
'''


@pytest.fixture(autouse=True)
def registry_as_before(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(registry, "_added", {kind: dict(terms) for kind, terms in registry._added.items()})


@pytest.fixture
def outside(tmp_path: Path) -> dict:
    """A file with a reward and an observation is imported; the arguments that name them."""
    (tmp_path / "mine.py").write_text(FILE)
    spec = importlib.util.spec_from_file_location("mine", tmp_path / "mine.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return {
        "rewards": {"steady_speed": {"weight": 2.0, "width": 0.25}},
        "observations": {"projected_gravity": {}, "base_angular_velocity": {"scale": 0.5}, "slow_height": {}},
        "contacts": (),
    }


def expected_speed(v: np.ndarray, before: np.ndarray) -> np.ndarray:
    return 2.0 * 0.02 * np.exp(-np.square(v[:, 3:5] - before).sum(1) / 0.25)


@pytest.mark.slow
def test_a_reward_with_memory_and_an_observation_from_outside(outside: dict):
    """Both follow what numpy says, through resets; a single environment does the same, bit for bit."""
    n = 5
    envs = gymnasium.make_vec(ID, num_envs=n, autoreset_mode="SameStep", max_episode_steps=4, **outside)
    single = gymnasium.make(ID, max_episode_steps=4, **outside)
    assert list(envs.unwrapped.observation_structure.items())[2] == ("slow_height", 1)
    observation, _ = envs.reset(seed=0)
    np.testing.assert_array_equal(single.reset(seed=0)[0], observation[0])
    speed, height = np.tile([0.5, -0.5], (n, 1)), np.full(n, 0.25)
    height = 0.9 * height + 0.1 * envs.unwrapped.state()["q"][:, 2]
    np.testing.assert_allclose(observation[:, 6], height, rtol=1e-6)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(9):
        action = rng.uniform(-1, 1, (n, 12)).astype(np.float32)
        observation, _, terminated, truncated, infos = envs.step(action)
        one, *_, info = single.step(action[0])
        assert info["reward_steady_speed"] == infos["reward_terms"]["steady_speed"][0]
        done, state = terminated | truncated, envs.unwrapped.state()
        told, alive = infos["reward_terms"]["steady_speed"], ~done
        np.testing.assert_allclose(told[alive], expected_speed(state["v"], speed)[alive], rtol=1e-9)
        np.testing.assert_allclose(observation[alive, 3:6], 0.5 * state["v"][alive, :3], rtol=1e-5, atol=1e-6)
        height = np.where(done, 0.25, height) * 0.9 + 0.1 * state["q"][:, 2]
        np.testing.assert_allclose(observation[:, 6], height, rtol=1e-6)
        speed = np.where(done[:, None], [0.5, -0.5], state["v"][:, 3:5])
        if done[0]:
            ended += 1
            one, _ = single.reset()
        np.testing.assert_array_equal(one, observation[0])
    assert ended


def test_memory_is_in_the_schema(outside: dict):
    schema = make_program("mini_cheetah", "velocity", transmission="none", **outside).schema
    assert schema["reward_steady_speed_speed"].size == 2
    assert schema["observation_slow_height_height"].writer == "term"
    assert "reward_steady_speed_speed" not in make_program("mini_cheetah", "velocity").schema


TASKS = {
    "plain": {},
    "airborne": {"contacts": ()},
    "everything": {
        "noise": {"joint_positions": 0.02},
        "history": 2,
        "latency": (0, 2),
        "randomise": {"friction": (0.5, 1.2)},
        "push_period": 0.1,
        "heading": True,
        "critic": ["contact_forces"],
        "contact_forces": True,
        "command_curriculum": 0.3,
        "terrain": "stairs",
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("options", TASKS.values(), ids=TASKS)
def test_the_schema_is_what_the_programs_have(options: dict):
    """Every state buffer of the compiled programs is in the schema, with its size, and vice versa."""
    program = make_program("mini_cheetah", "velocity", **options)
    used = {}
    for one in (program.step_program(), program.reset_program()):
        used |= {b.name: b.size for b in one.buffers if b.kind == "tiles"}
    assert used == program.state_sizes


def test_parameters_of_the_package_s_terms():
    """A width changes the reward as its formula says; alone it leaves the weight as it was."""
    program = make_program("mini_cheetah", "velocity", rewards={"track_linear_velocity": {"width": 1.0}, "torques": 0})
    term = program.reward_terms["track_linear_velocity"]
    assert (term.weight, dict(term.parameters)) == (1.5, {"width": 1.0})
    assert "torques" not in program.reward_terms
    s = {"q": np.r_[0, 0, 0.3, 1, np.zeros(15)], "v": np.r_[np.zeros(3), 0.4, np.zeros(14)]}
    other = make_program("mini_cheetah", "velocity", terminations={"tilt": {"angle": 0.5}, "fallen": {"share": 2.0}})
    look = other.stages.observation_function()
    values = {name: np.zeros(look.size1_in(name)) for name in look.name_in()} | s
    failed = look.call([values[name] for name in look.name_in()])[-1]
    assert float(failed) == 1.0, "lower than twice the standing height"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rewards": {"torques": 1e308}}, r"rewards\['torques'\]=1e\+308; expected a weight from -1e\+09 to 1e\+09"),
        ({"rewards": {"torques": -1e200}}, r"rewards\['torques'\]=-1e\+200; expected a weight"),
        ({"rewards": {"survive": {}}}, r"rewards\['survive'\]=\{\}; expected a `weight`"),
        ({"rewards": {"torques": {"width": 1.0}}}, "reward term 'torques': parameter 'width'; expected none"),
        ({"rewards": {"track_linear_velocity": {"width": "wide"}}}, "width='wide'; expected a finite number"),
        ({"rewards": [1.0]}, r"rewards=\[1.0\]; expected weights, or mappings"),
        ({"observations": {"joint_velocities": {"size": 1}}}, "parameter 'size'; expected one of scale"),
        ({"observations": {"joint_velocities": 0.1}}, r"observations\['joint_velocities'\]=0.1; expected parameters"),
        ({"observations": {}}, "expected at least one name"),
    ],
)
def test_wrong_arguments_of_terms(options: dict, message: str):
    with pytest.raises(ValueError, match=message) as caught:
        make_program("mini_cheetah", "velocity", **options)
    assert "\n" not in str(caught.value)


def branches(s):
    return 1.0 if s.base_height > 0.3 else 0.0


def three_numbers(s):
    return s.command


def forgets(s):
    s.keep("speed", s.command)
    return s.base_height


def returns_nothing(s):
    s.q[0]


def multiplies_shapes(s):
    return ca.mtimes(s.q, s.v)


WRONG = {
    branches: r"reward term 'branches': a condition on a traced value .*; expected ca.if_else",
    three_numbers: r"reward term 'three_numbers' has shape \(3, 1\); expected one number",
    forgets: r"reward_forgets: keep\('speed'\) of 3 numbers; expected recall\('speed', size=3\) before",
    returns_nothing: r"reward term 'returns_nothing': returns None; expected a CasADi expression",
    multiplies_shapes: r"reward term 'multiplies_shapes': .*expected arithmetic of CasADi expressions",
}


@pytest.mark.parametrize("term", WRONG, ids=lambda term: term.__name__)
def test_what_is_wrong_with_a_term_is_said_in_one_line(term):
    ce_gym.reward(term)
    with pytest.raises(ValueError, match=WRONG[term]) as caught:
        make_program("mini_cheetah", "velocity", rewards={term.__name__: 1.0})
    assert "\n" not in str(caught.value)
    assert "casadi/" not in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_functions_of_numpy_are_quiet():
    @ce_gym.reward
    def numpys(s):
        return np.exp(-(s.base_height**2)) + np.sqrt(s.q[2])

    assert make_program("mini_cheetah", "velocity", rewards={"numpys": 1.0}).stages.user_terms


def test_a_parameter_needs_a_default():
    with pytest.raises(ValueError, match="reward term 'needy': parameter 'width' has no default; expected one"):

        @ce_gym.reward
        def needy(s, width):
            return width


def test_feet_are_asked_for_where_there_are_none(tmp_path: Path):
    source = Path(ce_gym.load_robot("mini_cheetah").source)
    for file in source.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    path = tmp_path / source.name
    path.write_text(path.read_text().replace("group: foot", "group: hoof"))
    with pytest.raises(ValueError, match=r"reward_feet_air_time: mini_cheetah has no contact spheres of group 'foot'"):
        make_program(str(path), "velocity", contacts=())
    assert make_program(str(path), "stand", contacts=(), terminations=()).schema


def test_a_robot_itself_is_refused_in_one_line():
    robot = ce_gym.load_robot("mini_cheetah")
    with pytest.raises(ValueError, match=r"^robot=the Robot 'mini_cheetah'; expected the name of a robot or a path"):
        gymnasium.make(ID, robot=robot)
    with pytest.raises(
        ce_gym.RobotError, match=r"path is .*Robot 'mini_cheetah'.*: expected the path of a file"
    ) as caught:
        ce_gym.register_robot(robot)  # type: ignore[arg-type]
    assert len(str(caught.value)) < 200
