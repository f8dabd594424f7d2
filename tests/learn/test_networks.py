"""The compiled networks against torch: forwards, PPO's gradient, Adam, advantages."""

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from ce_gym.learn.networks.perceptron import (
    KINDS,
    Network,
    actor_gradient,
    make_work,
    outputs,
    parameter_count,
    squared_error_gradient,
)
from ce_gym.learn.networks.updates import adam, estimate_advantages, sample_actions

F = np.float32
CLIP, ENTROPY, VALUE = 0.2, 0.01, 0.5


def make_network(rng, sizes, kind):
    """A network with random parameters, zero where it is padded, and the same as torch's layers."""
    network = Network(np.zeros(parameter_count(sizes), F), sizes, KINDS.index(kind))
    for weight, bias in network.layers():
        weight[:] = rng.standard_normal(weight.shape) / np.sqrt(len(weight))
        bias[:] = 0.1 * rng.standard_normal(bias.shape)
    return network, [
        (torch.tensor(w, requires_grad=True), torch.tensor(b, requires_grad=True)) for w, b in network.layers()
    ]


def run(layers, kind, x):
    activate = getattr(torch.nn, kind)()
    for i, (weight, bias) in enumerate(layers):
        x = (activate(x) if i else x) @ weight + bias
    return x


def close(layers, gradient, network):
    """Check that a vector of derivatives equals torch's, and is zero where it is padded."""
    rest = gradient.copy()
    for (weight, bias), (w, b) in zip(network._replace(theta=rest).layers(), layers, strict=True):
        np.testing.assert_allclose(weight, w.grad.numpy(), atol=2e-5, rtol=2e-4)
        np.testing.assert_allclose(bias, b.grad.numpy(), atol=2e-5, rtol=2e-4)
        weight[:], bias[:] = 0, 0
    assert not rest.any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hidden", [(16,), (20, 40, 8)])
def test_outputs_are_those_of_torch(kind, hidden):
    """Also where layers are no whole vectors and samples no whole chunks."""
    rng, sizes = np.random.default_rng(0), np.array([7, *hidden, 3])
    network, layers = make_network(rng, sizes, kind)
    observations, found = rng.standard_normal((301, 7)).astype(F), np.zeros((301, 3), F)
    outputs(network, observations, found, make_work(sizes))
    expected = run(layers, kind, torch.tensor(observations)).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=3e-6)


@pytest.fixture(scope="module", params=["Tanh", *(kind for kind in KINDS if kind != "Tanh")])
def minibatch(request):
    """Samples of which 150 of 200 count, some with a probability ratio beyond the clipping range."""
    rng = np.random.default_rng(1)
    actor, critic = np.array([7, 20, 33, 3]), np.array([9, 20, 33, 1])
    network, policy = make_network(rng, actor, request.param)
    seen, actions, log_std = rng.standard_normal((200, 7)), rng.standard_normal((200, 3)), np.array([-0.5, 0.1, 0.3], F)
    normal = Normal(run(policy, request.param, torch.tensor(seen, dtype=torch.float32)), torch.tensor(log_std).exp())
    log_probs = normal.log_prob(torch.tensor(actions, dtype=torch.float32)).sum(1).detach().numpy()
    return {
        "kind": request.param,
        "actor": (network, policy),
        "critic": make_network(rng, critic, request.param),
        "log_std": log_std,
        "seen": seen.astype(F),
        "known": rng.standard_normal((200, 9)).astype(F),
        "actions": actions.astype(F),
        "log_probs": (log_probs + 0.3 * rng.standard_normal(200)).astype(F),
        "advantages": rng.standard_normal(200).astype(F),
        "returns": rng.standard_normal(200).astype(F),
        "rows": rng.permutation(200)[:150],
    }


def test_the_gradient_is_that_of_torch(minibatch):
    m, rows = minibatch, minibatch["rows"]
    (actor, policy), (critic, value) = m["actor"], m["critic"]
    for layer in (*policy, *value):
        for parameter in layer:
            parameter.grad = None
    advantages = torch.tensor(m["advantages"][rows])
    centre, scale = advantages.mean(), 1 / (advantages.std() + 1e-8)
    log_std = torch.tensor(m["log_std"], requires_grad=True)
    normal = Normal(run(policy, m["kind"], torch.tensor(m["seen"][rows])), log_std.exp())
    log_ratio = normal.log_prob(torch.tensor(m["actions"][rows])).sum(1) - torch.tensor(m["log_probs"][rows])
    ratio, a = log_ratio.exp(), (advantages - centre) * scale
    objective = torch.min(a * ratio, a * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
    errors = run(value, m["kind"], torch.tensor(m["known"][rows]))[:, 0] - torch.tensor(m["returns"][rows])
    (VALUE * errors.square().mean() - objective - ENTROPY * normal.entropy().sum(1).mean()).backward()
    clipped = (ratio - 1).abs() > CLIP
    assert 0.1 < clipped.float().mean() < 0.9

    by_actor, by_log_std, by_critic = np.zeros_like(actor.theta), np.zeros(3, F), np.zeros_like(critic.theta)
    figures = np.zeros(3, F)
    scaling = (F(centre), F(scale), F(1 / 150))
    samples = (m["seen"], m["actions"], m["log_probs"], m["advantages"])
    work = make_work(actor.sizes, critic.sizes)
    actor_gradient(
        actor, m["log_std"], samples, rows, scaling, F(CLIP), F(ENTROPY), by_actor, by_log_std, figures, work
    )  # fmt: skip
    loss = squared_error_gradient(critic, m["known"], m["returns"][:, None], rows, F(VALUE / 150), by_critic, work)
    close(policy, by_actor, actor)
    close(value, by_critic, critic)
    np.testing.assert_allclose(by_log_std, log_std.grad.numpy(), atol=2e-5, rtol=2e-4)
    kl = (ratio - 1 - log_ratio).mean().item()
    assert loss / 150 == pytest.approx(errors.square().mean().item(), rel=1e-3)
    expected = (-objective.item(), kl, clipped.float().mean().item())
    np.testing.assert_allclose(figures, expected, rtol=1e-3)


def test_adam_is_that_of_torch():
    rng = np.random.default_rng(2)
    theta, moments = rng.standard_normal(40).astype(F), np.zeros((2, 40), F)
    parameter = torch.tensor(theta, requires_grad=True)
    optimizer = torch.optim.Adam([parameter], lr=3e-3, eps=1e-5)
    for step in range(1, 6):
        gradient = (10 ** rng.uniform(-3, 1) * rng.standard_normal(40)).astype(F)
        parameter.grad = torch.tensor(gradient)
        torch.nn.utils.clip_grad_norm_([parameter], 1.0)
        optimizer.step()
        adam(theta, gradient, moments, step, 3e-3, 1.0)
        np.testing.assert_allclose(theta, parameter.detach().numpy(), atol=1e-6)


def test_actions_are_drawn_with_their_probabilities():
    rng, log_std = np.random.default_rng(3), np.array([-0.5, 0.4], F)
    means, noise = (rng.standard_normal((50, 2)).astype(F) for _ in range(2))
    actions, clipped, log_probs = np.zeros((50, 2), F), np.zeros((50, 2), F), np.zeros(50, F)
    sample_actions(means, noise, log_std, actions, clipped, log_probs)
    np.testing.assert_allclose(actions, means + np.exp(log_std) * noise, atol=1e-6)
    np.testing.assert_array_equal(clipped, np.clip(actions, -1, 1))
    normal = Normal(torch.tensor(means), torch.tensor(log_std).exp())
    np.testing.assert_allclose(log_probs, normal.log_prob(torch.tensor(actions)).sum(1), atol=1e-5)


def test_advantages_are_discounted_sums_of_what_follows():
    """By their definition, episode by episode: each sum ends where the episode or the rollout does."""
    rng, gamma, decay = np.random.default_rng(4), 0.9, 0.8
    rewards, values = (rng.standard_normal((12, 3)).astype(F) for _ in range(2))
    last, dones = rng.standard_normal(3).astype(F), rng.random((12, 3)) < 0.2
    found = np.zeros((12, 3), F)
    estimate_advantages(rewards, values, last, dones, F(gamma), F(decay), found)
    following = np.concatenate([values[1:], last[None]])
    for t in range(12):
        for i in range(3):
            total, weight = 0.0, 1.0
            for k in range(t, 12):
                total += weight * (rewards[k, i] + gamma * following[k, i] * (not dones[k, i]) - values[k, i])
                weight *= gamma * decay
                if dones[k, i]:
                    break
            assert found[t, i] == pytest.approx(total, abs=1e-5)
