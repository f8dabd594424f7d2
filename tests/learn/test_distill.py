"""The student: its gradient against torch, the teacher's observation, learning, and resuming."""

import json
import os
import shlex
import signal
from dataclasses import asdict
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from test_networks import close, make_network, run
from toy import jobs, parameters

import ce_gym.__main__
from ce_gym.learn.evaluation.card import command, portable
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.learners import distill
from ce_gym.learn.learners.distill import Distiller, Settings, teacher_columns, train
from ce_gym.learn.networks.perceptron import KINDS, make_work, squared_error_gradient
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.settings import SettingsError, config_file, load_settings, read_file
from ce_gym.policies import PolicyError, load_policy

ROBOT = "ce_gym/MiniCheetahVelocity-v0"
FILES = sorted(Settings.folder.glob("*_*.yaml"))
SMALL = ["num_envs=64", "rollout=8", "minibatches=2"]
F = np.float32


def job(out, steps=4 * 512, settings=(), **changes):
    path = config_file(ROBOT, Settings.folder)
    chosen = load_settings(path, [*SMALL, f"steps={steps}", *settings], Settings)
    return Job("distill", ROBOT, chosen, out, **({"env_kwargs": read_file(path)[1]} | changes))


def environments(task):
    options = {**task.env_kwargs, **task.settings.training, "autoreset_mode": "SameStep"}
    return gymnasium.make_vec(ROBOT, num_envs=task.settings.num_envs, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_torch(kind):
    rng, sizes = np.random.default_rng(0), np.array([7, 20, 16, 3])
    network, layers = make_network(rng, sizes, kind)
    seen, labels = (rng.standard_normal((401, n)).astype(F) for n in (7, 3))
    rows, gradient = rng.permutation(401)[:301], np.zeros_like(network.theta)
    weight = F(1 / (301 * 3))
    samples = (network, seen, labels, rows, weight, gradient, make_work(sizes))
    found = weight * squared_error_gradient(*samples)
    loss = ((run(layers, kind, torch.tensor(seen[rows])) - torch.tensor(labels[rows])) ** 2).mean()
    loss.backward()
    assert found == pytest.approx(loss.item(), rel=1e-5)
    close(layers, gradient, network)


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_teacher_sees_the_numbers_of_its_own_environment(path):
    """Of shipped files, whose students see late, noisy, in the wrong place: the teacher is shown the truth."""
    settings, kwargs = load_settings(path, kind=Settings), read_file(path)[1]
    assert settings.num_envs * settings.rollout % settings.minibatches == 0
    teacher = load_policy(settings.teacher)
    exactly = {"start": {}, "push_period": 0.0, "randomise": {}, "noise": {}}
    his, mine = (
        gymnasium.make_vec(teacher.record["env"], num_envs=4, **{**given, **exactly})
        for given in (teacher.record["env_kwargs"], kwargs)
    )
    columns = teacher_columns(teacher, settings.teacher, mine.unwrapped, kwargs)
    his.reset(seed=0), mine.reset(seed=0)
    for envs in (his, mine):
        envs.step(np.zeros(envs.action_space.shape, F))
    there, here = his.unwrapped.batch, mine.unwrapped.batch
    for name, row in there.schema.items():
        if not row.dtype and name in here.schema and here.schema[name].size == row.size:
            here.write(name, there.rows(name))  # the state without the memory of sensors
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, mine.action_space.shape).astype(F)
    theirs, (seen, *_) = his.step(actions)[0], mine.step(actions)
    theirs = theirs["policy"] if isinstance(theirs, dict) else theirs
    np.testing.assert_allclose(seen["critic"][:, columns], theirs, atol=2e-6)
    student = set(mine.unwrapped.observation_structure)
    assert not student & {"base_linear_velocity", "base_height", "contact_forces", "base_angular_velocity"}


def test_blocks_of_the_critic_are_named_in_order():
    envs = gymnasium.make_vec(ROBOT, num_envs=1, obs_mode="dict", critic=["base_height", "contact_forces"], history=2)
    known = envs.unwrapped.critic_structure
    assert list(known) == [*envs.unwrapped.observation_structure, "base_height", "contact_forces"]
    assert sum(known.values()) == envs.single_observation_space["critic"].shape[0]
    plain = gymnasium.make_vec(ROBOT, num_envs=1).unwrapped
    assert plain.critic_structure == plain.observation_structure


def test_the_student_acts_and_the_teacher_labels(tmp_path):
    """Samples are the student's own states, and the teacher's action in each."""
    task = job(tmp_path, settings=["initial_std=0.05"])
    learner = Distiller(environments(task), task)
    learner.theta[:] = 0  # its mean action is 0
    given, step = [], learner.envs.step

    def watched(actions):
        given.append(actions.copy())
        return step(actions)

    learner.envs.step = watched
    before = learner.observed[1].copy()
    learner.collect(0.0)
    assert np.std(given) == pytest.approx(0.05, rel=0.05)
    expected = learner.teacher.predict(before[:, learner.columns])[0]
    np.testing.assert_array_equal(learner.labels[0], expected)
    assert np.abs(learner.labels).mean() > 0.05


@pytest.mark.slow
def test_it_learns_to_walk_without_the_velocity_of_its_base(tmp_path):
    trained = train(job(tmp_path, 300_000, ["num_envs=256", "rollout=24", "minibatches=8"], seed=3))
    assert "base_linear_velocity" not in str(trained.record["policy_spec"]["observation"]["blocks"])
    result = evaluate(load_policy(trained.policy), ROBOT, episodes=64, **trained.record["env_kwargs"])
    assert result["falls"] <= 0.25
    assert result["forward_error"] < 0.25
    log = (tmp_path / "progress.csv").read_text().splitlines()
    assert "train/error" in log[0]


def test_the_command_on_its_card_repeats_it(tmp_path):
    record = load_policy(train(job(tmp_path)).policy).record
    assert record["learner"] == "distill"
    words = shlex.split(command(record))
    assert words[:6] == ["python", "-m", "ce_gym", "train", ROBOT, "--algo"]
    (again,) = jobs(*words[4:])
    assert json.loads(json.dumps(asdict(again.settings))) == record["settings"]
    assert again.env_kwargs == record["env_kwargs"]
    elsewhere = portable(record | {"settings": {**record["settings"], "teacher": "/home/me/runs/walk/policy.npz"}})
    assert elsewhere["settings"]["teacher"] == "policy.npz"


def test_interrupted_and_resumed_is_as_if_it_never_stopped(tmp_path, monkeypatch):
    whole = train(job(tmp_path / "whole"))
    iterate, count = Distiller.iterate, iter(range(100))

    def interrupting(learner):
        if next(count) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return iterate(learner)

    with monkeypatch.context() as patch:
        patch.setattr(Distiller, "iterate", interrupting)
        part = train(job(tmp_path / "part"))
    assert part.interrupted
    assert part.record["steps"] == 2 * 512
    rest = train(job(tmp_path / "rest", resume=part.policy, threads=2))
    np.testing.assert_array_equal(parameters(whole.policy), parameters(rest.policy))
    with pytest.raises(PolicyError, match=r"has layers \[\d+, 128, 64, 12\], Tanh; expected \[\d+, 8, 12\]"):
        train(job(tmp_path / "other", settings=["hidden=[8]"], resume=part.policy))


def columns(teacher, known=None, **scan):
    """Columns of a teacher's observation, for Mini Cheetah on stairs with other sizes and another `height_scan`."""
    policy, kwargs = load_policy(teacher), read_file(Settings.folder / "mini_cheetah_stairs.yaml")[1]
    sizes = {block["name"]: block["size"] for block in policy.record["policy_spec"]["observation"]["blocks"]}
    kwargs["observations"]["height_scan"] |= scan
    return teacher_columns(policy, teacher, SimpleNamespace(critic_structure=known or sizes), kwargs)


def test_columns_are_in_the_order_of_the_teacher():
    assert (np.diff(columns("mini_cheetah_stairs")) == 1).all()


@pytest.mark.parametrize(
    ("teacher", "known", "scan", "said"),
    [
        (
            "mini_cheetah_velocity",
            {"gyro": 3},
            {},
            "observes base_linear_velocity; expected one of the critic's blocks",
        ),
        (
            "mini_cheetah_velocity",
            {"base_linear_velocity": 2},
            {},
            "observes base_linear_velocity with {}, size 3; here it has {}, size 2",
        ),
        (
            "mini_cheetah_stairs",
            None,
            {"centre": [0.2, 0.0]},
            r"observes height_scan with .*'centre': \[0.1, 0.0\].*here it has .*0.2",
        ),
        ("mini_cheetah_stairs", None, {"clip": 0.5}, r"observes height_scan with .*here it has .*'clip': 0.5"),
        ("mini_cheetah_rough", None, {}, "mini_cheetah_rough: history=3; expected a teacher without history"),
    ],
)
def test_a_teacher_without_its_observation_is_refused_in_one_line(teacher, known, scan, said):
    with pytest.raises(PolicyError, match=said) as caught:
        columns(teacher, known, **scan)
    assert "\n" not in str(caught.value)


def test_observations_of_the_student_alone_are_one_line(tmp_path):
    envs = SimpleNamespace(unwrapped=None, single_observation_space=gymnasium.spaces.Box(-1, 1, (5,)))
    envs.single_action_space = gymnasium.spaces.Box(-1, 1, (12,))
    with pytest.raises(PolicyError, match="obs_mode: expected dict"):
        Distiller(envs, job(tmp_path))


def test_wrong_settings_are_one_line(capsys, tmp_path):
    with pytest.raises(SettingsError, match=r"teacher=3; expected a name or a path"):
        load_settings(FILES[0], ["teacher=3"], Settings)
    words = ["train", ROBOT, "--algo", "distill", "--set", "teacher=nobody", "--out", str(tmp_path)]
    assert ce_gym.__main__.main(words) == 2
    error = capsys.readouterr().err.strip()
    assert "nobody" in error
    assert "\n" not in error


def test_every_student_of_a_shipped_file_has_a_shipped_teacher():
    for path in FILES:
        teacher = load_settings(path, kind=distill.Settings).teacher
        assert any(name.startswith(teacher) for name in ce_gym.shipped_policies()), path
