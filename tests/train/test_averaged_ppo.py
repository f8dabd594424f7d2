"""Two processes that learn one policy: the mean of their gradients, the same parameters, what goes on elsewhere."""

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from averaged_ppo import share
from fast_ppo import FastPPO
from meeting import free_port, learn
from run_learner import environments
from settings import SettingsError
from toy import job as toy_job

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return toy_job(tmp_path_factory.mktemp("run"), 20480, settings=["target_kl=0.02"])


@pytest.fixture(scope="module")
def both(job):
    port = free_port()
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        return list(pool.map(learn, [job] * 2, [port] * 2, range(2), [2] * 2, [20] * 2))


def test_gradients_are_averaged(both):
    pairs = zip(both[0]["averages"], both[1]["averages"], strict=True)
    for (mine, mean), (its, same) in pairs:
        assert (mine != its).any()
        np.testing.assert_array_equal(mean, same)
        np.testing.assert_array_equal(mean, (mine + its) / np.float32(2))


def test_all_have_one_policy_and_rollouts_of_their_own(both):
    np.testing.assert_array_equal(both[0]["theta"], both[1]["theta"])
    assert (both[0]["actions"] != both[1]["actions"]).mean() > 0.99
    assert both[0]["figures"]["train/learning_rate"] == both[1]["figures"]["train/learning_rate"]


def test_it_learns(both):
    for found in both:
        rewards = [reward for reward in found["rewards"] if reward == reward]
        assert rewards[-1] > rewards[0] + 5.0  # of 50


def test_one_process_goes_on_from_what_two_learnt(job, both):
    learned = both[0]["learned"]
    assert json.loads(str(learned["facts"]))["steps"] == 20 * 64 * 16
    alone = FastPPO(environments(job), job)
    alone.restore(learned)
    assert alone.steps == 20 * 64 * 16
    np.testing.assert_array_equal(alone.theta, both[0]["theta"])


def test_two_go_on_from_what_was_learnt(both):
    for found in both:
        assert found["restored"][0] == 20 * 32 * 16
        np.testing.assert_array_equal(found["restored"][1], found["theta"])
    assert (both[0]["noise"] != both[1]["noise"]).all()


def test_environments_that_cannot_be_divided_are_one_line(job):
    with pytest.raises(SettingsError, match="num_envs: 64; expected a multiple of the 3 workers"):
        share(job, 0, 3)
