"""The learner with analytic gradients: its gradients against torch and differences, and that it goes on as it was."""

import json
import shlex
import signal
from dataclasses import asdict

import gymnasium
import numpy as np
import pytest
import torch
from test_networks import close, make_network, run
from toy import jobs, parameters
from tripod import TRIPOD

from ce_gym import environment_ids
from ce_gym.envs.differentiable import _roughness
from ce_gym.envs.runtime.setup import make_program
from ce_gym.learn.evaluation.card import command
from ce_gym.learn.learners import shac
from ce_gym.learn.learners.shac import SHAC, Settings, train
from ce_gym.learn.networks.perceptron import KINDS, back_through, make_work
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.settings import SettingsError, config_file, load_settings, read_file
from ce_gym.policies import PolicyError, load_policy

ROBOT = "ce_gym/MiniCheetahVelocity-v0"
SMALL = ["num_envs=16", "rollout=4", "hidden=[16]", "minibatches=2", "training={}"]
PLAIN = ["max_adjoint=1e30", "gamma=0.9"]
F = np.float32


def job(out, steps=4 * 64, settings=(), **changes):
    chosen = load_settings(config_file(ROBOT, Settings.folder), [*SMALL, *PLAIN, f"steps={steps}", *settings], Settings)
    return Job("shac", ROBOT, chosen, out, **({"env_kwargs": {"dtype": "float64", "robot": TRIPOD}} | changes))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hidden", [(16,), (20, 40, 8)])
def test_the_way_back_through_a_network_is_that_of_torch(kind, hidden):
    rng, sizes = np.random.default_rng(0), np.array([7, *hidden, 3])
    network, layers = make_network(rng, sizes, kind)
    seen, by_output = (rng.standard_normal((301, n)).astype(F) for n in (7, 3))
    gradient, by_seen = np.zeros_like(network.theta), np.zeros_like(seen)
    back_through(network, seen, by_output, gradient, by_seen, make_work([16], sizes))
    x = torch.tensor(seen, requires_grad=True)
    (run(layers, kind, x) * torch.tensor(by_output)).sum().backward()
    close(layers, gradient, network)
    assert x.grad is not None
    np.testing.assert_allclose(by_seen, x.grad.numpy(), atol=1e-5)


class Window:
    """The objective of a policy: discounted rewards of a window and the value of its end, with the same noise."""

    def __init__(self, learner: SHAC) -> None:
        native = learner.envs.unwrapped
        self.learner, self.start, self.observed = learner, native.snapshot(), learner.observed
        self.theta, self.noise = learner.policy.theta.copy(), learner.rng.bit_generator.state

    def act(self, change: np.ndarray) -> float:
        learner, s = self.learner, self.learner.settings
        learner.envs.unwrapped.restore(self.start)
        learner.observed, learner.rng.bit_generator.state = self.observed, self.noise
        learner.policy.theta[:] = self.theta + change
        learner.collect(0.5)
        learner.policy.theta[:] = self.theta
        worth = learner.run(learner.target_value, learner.after[-1])
        discounts = s.gamma ** np.arange(s.rollout + 1)
        return float((discounts[:-1] @ learner.rewards + discounts[-1] * worth[:, 0]).sum()) / s.num_envs


def test_the_gradient_of_a_window_is_that_of_differences(tmp_path, monkeypatch):
    envs = gymnasium.make_vec(ROBOT, robot=TRIPOD, num_envs=16, autoreset_mode="SameStep", only_positive=True)
    learner = SHAC(envs, job(tmp_path))
    for _ in range(3):
        learner.iterate()
    window, found = Window(learner), []
    monkeypatch.setattr(shac, "adam", lambda _theta, gradient, *_: found.append(-gradient))
    learner.differentiable.clear()
    window.act(np.zeros_like(window.theta))
    learner._learn_policy(1e-3)
    size = 1e-3 / np.linalg.norm(found[0])
    slope = (window.act(size * found[0]) - window.act(-size * found[0])) / (2 * size)
    assert slope == pytest.approx(float(found[0] @ found[0]), rel=0.02)


def test_interrupted_and_resumed_is_as_if_it_never_stopped(tmp_path, monkeypatch):
    whole = train(job(tmp_path / "whole"))
    iterate = SHAC.iterate

    def interrupting(learner):
        if learner.steps == 64:
            signal.raise_signal(signal.SIGINT)
        return iterate(learner)

    monkeypatch.setattr(SHAC, "iterate", interrupting)
    part = train(job(tmp_path / "part"))
    assert part.interrupted
    assert part.record["steps"] == 2 * 64
    rest = train(job(tmp_path / "rest", resume=part.policy))
    np.testing.assert_array_equal(parameters(whole.policy), parameters(rest.policy))
    other = train(job(tmp_path / "other", seed=1, steps=2 * 64))
    assert not np.array_equal(parameters(part.policy), parameters(other.policy))
    record = load_policy(whole.policy).record
    assert record["learner"] == "shac"
    words = shlex.split(command(record))
    assert words[:6] == ["python", "-m", "ce_gym", "train", ROBOT, "--algo"]
    (again,) = jobs(*words[4:])
    assert json.loads(json.dumps(asdict(again.settings))) == record["settings"]
    with pytest.raises(PolicyError, match=r"has layers \[18, 16, 2, 2\], Tanh; expected \[18, 8, 2, 2\]"):
        train(job(tmp_path / "other", settings=["hidden=[8]"], resume=part.policy))


def test_a_critic_with_more_observations_is_refused_in_one_line(tmp_path):
    kwargs = {"robot": TRIPOD, "obs_mode": "dict"}
    with pytest.raises(PolicyError, match="obs_mode: dict; expected vector"):
        train(job(tmp_path, env_kwargs=kwargs))


def test_a_batch_of_more_robots_than_a_chunk_trains(tmp_path):
    trained = train(job(tmp_path, 2 * 4 * 200, ["num_envs=200"]))
    assert np.isfinite(parameters(trained.policy)).all()


def test_the_policy_squashes_its_actions(tmp_path):
    trained = train(job(tmp_path, 64))
    seen = 100 * np.random.default_rng(0).standard_normal((50, 18)).astype(F)
    actions = load_policy(trained.policy).predict(seen)[0]
    assert np.abs(actions).max() <= 1.0
    assert not np.isin(np.abs(actions), 1.0).all()
    *_, (identity, bias) = trained.model.act.layers
    np.testing.assert_array_equal(identity, np.eye(2))
    assert not bias.any()


@pytest.mark.parametrize("path", sorted(Settings.folder.glob("*_*.yaml")), ids=lambda path: path.stem)
def test_rewards_of_every_shipped_file_have_a_gradient(path):
    settings, ids = load_settings(path, kind=Settings), environment_ids()
    assert settings.num_envs * settings.rollout % settings.minibatches == 0
    kwargs = next(kwargs for env_id, kwargs in ids.items() if config_file(env_id, Settings.folder) == path)
    program = make_program(**(kwargs | read_file(path)[1] | settings.training))
    rough = {name: _roughness(program.stages, term) for name, term in program.reward_terms.items()}
    assert set(rough.values()) <= {"", "kinks"}, rough


def test_wrong_settings_are_one_line():
    for change, message in (
        ("training=[1]", r"training: \[1\]; expected arguments of the environment by name"),
        ("clip=0.2", "clip: unknown setting; expected one of steps"),
        ("max_adjoint=0", "max_adjoint=0; expected a positive number"),
    ):
        with pytest.raises(SettingsError, match=message):
            load_settings(config_file(ROBOT, Settings.folder), [change], Settings)
