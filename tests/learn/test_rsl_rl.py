"""rsl_rl's own PPO learns on our environments, stops, resumes, and leaves a policy that the other programs read."""

import os
import signal

import numpy as np
import pytest

pytest.importorskip("rsl_rl")
import torch
from point_mass import ID
from rsl_rl.runners import OnPolicyRunner
from rsl_rl_ppo import main, train
from toy import SMALL, job

from ce_gym.__main__ import main as ce_gym_main
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.policies import PolicyError, load_policy

SETTINGS = ["--set", *SMALL]
ITERATION = 64 * 16


def run(*args, **options):
    return train(job(*args, **options).replace(algo="rsl_rl"))


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def runners(monkeypatch):
    """All runners that a test makes."""
    made = []
    init = OnPolicyRunner.__init__
    monkeypatch.setattr(
        OnPolicyRunner, "__init__", lambda self, *args, **options: (made.append(self), init(self, *args, **options))[1]
    )
    return made


def numbers(folder):
    return sorted(int(file.stem.removeprefix("model_")) for file in folder.glob("model_*.pt"))


@pytest.mark.parametrize("obs_mode", ["vector", "dict"])
def test_rsl_rl_learns(obs_mode, tmp_path, runners):
    trained = run(tmp_path, 30_000, env_kwargs={"obs_mode": obs_mode})
    (runner,) = runners
    assert runner.alg.critic.obs_groups == ["critic" if obs_mode == "dict" else "policy"]
    result = evaluate(trained.model, ID, episodes=32, obs_mode=obs_mode)
    assert result["forward_error"] < 0.15  # half a unit without learning
    assert result["falls"] == 0.0
    obs = runner.env.get_observations()
    expected = runner.get_inference_policy()(obs).detach().clamp(-1, 1).numpy()
    np.testing.assert_allclose(trained.model.predict(obs["policy"].numpy())[0], expected, atol=1e-6)


def test_the_program_leaves_a_policy_with_its_contract(tmp_path, capsys):
    assert main([ID, "--steps", "3e3", "--episodes", "4", "--out", str(tmp_path), *SETTINGS]) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(tmp_path / "policy.npz")
    record = load_policy(tmp_path).record
    assert (record["env"], record["learner"], record["steps"]) == (ID, "rsl_rl", 3 * ITERATION)
    assert record["policy_spec"]["joints"] == ["slider"]
    assert ce_gym_main(["evaluate", str(tmp_path), "--episodes", "4"]) == 0
    assert numbers(tmp_path) == [0, 1, 2]


def test_an_interrupted_run_is_resumed_with_its_optimiser_and_iterations(tmp_path, capsys, monkeypatch, runners):
    update, count = None, iter(range(1000))

    def interrupting(runner, *args, **options):
        nonlocal update
        update = runner.alg.update

        def update_and_interrupt():
            if next(count) == 2:
                os.kill(os.getpid(), signal.SIGINT)
            return update()

        runner.alg.update = update_and_interrupt
        return learn(runner, *args, **options)

    learn = OnPolicyRunner.learn
    with monkeypatch.context() as patch:
        patch.setattr(OnPolicyRunner, "learn", interrupting)
        rate = ["--set", "learning_rate=1e-3"]
        assert main([ID, "--steps", "20e3", "--out", str(tmp_path), *SETTINGS, *rate]) == 130
    assert f"python train/rsl_rl_ppo.py --resume {tmp_path}" in capsys.readouterr().out
    assert max(numbers(tmp_path)) == 2
    record = load_policy(tmp_path).record
    assert (record["steps"], record["finished"]) == (3 * ITERATION, False)

    seen = {}

    def watching(runner, iterations, **options):
        moments = runner.alg.optimizer.state_dict()["state"][0]
        seen.update(start=runner.current_learning_iteration, iterations=iterations, rate=runner.alg.learning_rate)
        seen.update(step=moments["step"].item(), average=moments["exp_avg"].clone())
        return learn(runner, iterations, **options)

    monkeypatch.setattr(OnPolicyRunner, "learn", watching)
    assert main(["--resume", str(tmp_path), "--episodes", "4"]) == 0
    saved = torch.load(tmp_path / "model_2.pt", weights_only=True)["optimizer_state_dict"]
    assert (seen["start"], seen["iterations"]) == (3, 17)  # of 20
    assert seen["step"] == 3 * 4 * 2  # iterations, epochs, minibatches
    assert torch.equal(seen["average"], saved["state"][0]["exp_avg"])
    assert seen["rate"] == saved["param_groups"][0]["lr"] != 1e-3
    assert max(numbers(tmp_path)) == 19
    record = load_policy(tmp_path).record
    assert (record["steps"], record["finished"]) == (20 * ITERATION, True)
    assert record["settings"]["hidden"] == [16]
    before = len(runners)
    assert main(["--resume", str(tmp_path), "--episodes", "4"]) == 0  # nothing is left to learn
    assert max(numbers(tmp_path)) == 19
    assert len(runners) == before + 1


def test_what_cannot_be_resumed_is_refused_in_one_line(tmp_path):
    policy = run(tmp_path / "run", 1024).policy
    with pytest.raises(PolicyError, match=r"model_0\.pt: training cannot continue: .*size mismatch"):
        run(tmp_path / "out", 2048, settings=["hidden=[8]"], resume=policy)

    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    torch.save({"iter": Trap()}, policy.with_name("model_1.pt"))
    with pytest.raises(PolicyError, match=r"model_1\.pt: training cannot continue"):
        run(tmp_path / "out", 2048, resume=policy)
    assert not (tmp_path / "sprung").exists()
    for file in policy.parent.glob("model_*.pt"):
        file.unlink()
    with pytest.raises(PolicyError, match=r"has no model_\*\.pt"):
        run(tmp_path / "out", 2048, resume=policy)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["nobody/Nothing-v0"], "nobody"),
        ([ID, "--set", "gamma=x"], "gamma"),
        (["--resume", "missing"], "missing: no such policy"),
        ([], "ENV: missing"),
    ],
)
def test_mistakes_are_one_line(argv, words, capsys, tmp_path):
    assert main([*argv, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
