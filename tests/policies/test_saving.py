"""Networks of other libraries, saved as policies: they act as before, and no code of a file is run."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from point_mass import ID
from stander import ENV

from ce_gym.policies import ACTIVATIONS, Actor, PolicyError, load_policy, read_actor, save

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

from ce_gym.adapters.sb3 import make_sb3_vec_env  # noqa: E402
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy  # noqa: E402

nn = torch.nn
SUFFIXES = (".npz", ".onnx")
OBS = np.random.default_rng(0).standard_normal((300, 2)).astype(np.float32)


@pytest.fixture
def envs() -> Any:
    return make_sb3_vec_env(ID, 4)


def layers(activation: Any, seed: int = 0) -> Any:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(2, 16), activation, nn.Linear(16, 16), activation, nn.Linear(16, 1))


def expected(module: Any, observations: np.ndarray = OBS) -> np.ndarray:
    with torch.no_grad():
        return module(torch.from_numpy(observations)).clamp(-1, 1).numpy()


def assert_acts_as(file: Path, actions: np.ndarray, observations: np.ndarray = OBS) -> None:
    found = load_policy(file).predict(observations)[0]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, actions, rtol=0, atol=1e-6)
    np.testing.assert_allclose(load_policy(file).predict(observations[3])[0], actions[3], rtol=0, atol=1e-6)
    assert np.ptp(actions) > 0.01


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_network_of_torch(activation: str, suffix: str, envs: Any, tmp_path: Path) -> None:
    module = layers(getattr(nn, activation)())
    module[4].weight.data *= 4  # some actions are clipped
    file = save(module, envs, tmp_path / f"walk{suffix}")
    assert_acts_as(file, expected(module))
    record = load_policy(file).record
    assert (record["env"], record["env_kwargs"], record["activation"]) == (ID, {}, activation)
    assert module.training


class Residual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first, self.last, self.norm = nn.Linear(2, 8), nn.Linear(8, 1), nn.BatchNorm1d(8)
        self.norm(torch.randn(50, 8))

    def forward(self, x: Any) -> Any:
        hidden = self.norm(torch.relu(self.first(x)))
        return torch.tanh(self.last(hidden + torch.sin(hidden)))


OTHERS = {
    "silu": lambda: layers(nn.SiLU()),
    "leaky": lambda: layers(nn.LeakyReLU()),
    "normalised": lambda: nn.Sequential(nn.Linear(2, 8), nn.LayerNorm(8), nn.ELU(), nn.Linear(8, 1)),
    "squashed": lambda: nn.Sequential(nn.Linear(2, 8), nn.ELU(), nn.Linear(8, 1), nn.Tanh()),
    "mixed": lambda: nn.Sequential(nn.Linear(2, 8), nn.ELU(), nn.Linear(8, 8), nn.Tanh(), nn.Linear(8, 1)),
    "new batch norm": lambda: nn.Sequential(nn.Linear(2, 8), nn.BatchNorm1d(8), nn.ELU(), nn.Linear(8, 1)),
    "residual": Residual,
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_networks_need_onnx(name: str, envs: Any, tmp_path: Path) -> None:
    module = OTHERS[name]()
    file = save(module, envs, tmp_path / "walk.onnx")
    assert_acts_as(file, expected(module.eval()))
    with pytest.raises(PolicyError, match=r"walk\.npz: the network is not linear layers .* save it as \.onnx"):
        save(module, envs, tmp_path / "walk.npz")
    assert not (tmp_path / "walk.npz").exists()


class Functional(nn.Module):
    """Layers whose activation is a function, beside layers that do not act."""

    def __init__(self) -> None:
        super().__init__()
        self.one, self.two = nn.Linear(2, 8), nn.Linear(8, 1, bias=False)

    def forward(self, x: Any) -> Any:
        return self.two(nn.functional.elu(self.one(x)))


def test_activations_that_are_functions(envs: Any, tmp_path: Path) -> None:
    module = Functional()
    assert_acts_as(save(module, envs, tmp_path / "walk.npz"), expected(module))
    assert read_actor(tmp_path / "walk.npz")[0].activation == "ELU"


@pytest.mark.parametrize("make", [torch.jit.script, lambda module: torch.jit.trace(module, torch.zeros(1, 2))])
@pytest.mark.parametrize("activation", [nn.ELU(), nn.SiLU()])
def test_a_loaded_torchscript(make: Any, activation: Any, envs: Any, tmp_path: Path) -> None:
    module = layers(activation)
    make(module).save(str(tmp_path / "net.pt"))
    suffix = ".npz" if isinstance(activation, nn.ELU) else ".onnx"
    assert_acts_as(save(torch.jit.load(tmp_path / "net.pt"), envs, tmp_path / f"walk{suffix}"), expected(module))


@pytest.mark.parametrize("name", ["net.pt", "net.pth", "net.pkl"])
def test_files_with_code_are_not_loaded(name: str, envs: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.jit.script(layers(nn.ELU())).save(str(tmp_path / name))
    for module, function in ((torch.jit, "load"), (torch, "load"), (pickle, "load"), (pickle, "loads")):
        monkeypatch.setattr(module, function, lambda *_, **__: pytest.fail("loaded"))
    with pytest.raises(PolicyError, match=rf"{name}: .* runs code .* torch\.jit\.load\('{name}'\)") as caught:
        save(tmp_path / name, envs, tmp_path / "walk.npz")
    assert "\n" not in str(caught.value)


def write_onnx(module: Any, file: Path, example: Any = None, **options: Any) -> Path:
    torch.onnx.export(module, (torch.zeros(1, 2) if example is None else example,), file, dynamo=False, **options)
    return file


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_onnx_file_for_one_row(envs: Any, tmp_path: Path) -> None:
    module = OTHERS["squashed"]()
    source = write_onnx(module, tmp_path / "net.onnx", input_names=["obs"], output_names=["actions"])
    for policy in (source, str(source), onnx.load(source)):
        assert_acts_as(save(policy, envs, tmp_path / "walk.onnx"), expected(module))
    assert_acts_as(save(tmp_path / "walk.onnx", envs, tmp_path / "again.onnx"), expected(module))
    with pytest.raises(PolicyError, match=r"save it as \.onnx"):
        save(source, envs, tmp_path / "walk.npz")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_weights_of_an_onnx_file_in_another_file(envs: Any, tmp_path: Path) -> None:
    module = layers(nn.ELU())
    model = onnx.load(write_onnx(module, tmp_path / "net.onnx"))
    onnx.save(model, tmp_path / "net.onnx", save_as_external_data=True, location="weights", size_threshold=0)
    file = save(tmp_path / "net.onnx", envs, tmp_path / "walk.onnx")
    (tmp_path / "weights").unlink()
    assert_acts_as(file, expected(module))


class Memory(nn.Module):
    """The rows of a batch are a sequence."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRU(2, 1)

    def forward(self, x: Any) -> Any:
        return self.cell(x)[0]


class Values(nn.Module):
    def __init__(self, n: int) -> None:
        super().__init__()
        self.first, self.n = layers(nn.ELU()), n

    def forward(self, x: Any, *more: Any) -> Any:
        return (self.first(x) + sum(more), *(x,) * self.n)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_networks_that_cannot_be_saved(envs: Any, tmp_path: Path) -> None:
    two_outputs, damaged = Values(1), tmp_path / "damaged.onnx"
    source = write_onnx(two_outputs, tmp_path / "net.onnx")
    assert_acts_as(save(source, envs, tmp_path / "walk.onnx"), expected(two_outputs.first))
    torch.onnx.export(
        Values(1), (torch.zeros(1, 2), torch.zeros(1, 1)), tmp_path / "two.onnx", dynamo=False, input_names=["obs", "h"]
    )
    damaged.write_bytes(source.read_bytes()[:200])
    wide = nn.Linear(3, 1)
    cases = [
        (Memory(), r"actions depend on earlier or other observations|cannot be exported"),
        (nn.LSTM(2, 1), r"LSTM: .*expected a network from observations \(n, 2\)"),
        (wide, r"Linear: .*expected a network from observations \(n, 2\)"),
        (nn.Linear(2, 3), r"gives 3 numbers; expected the 1"),
        (nn.Sequential(nn.Linear(2, 3), nn.Tanh()), r"expected 1|full_check|cannot be completed"),
        (tmp_path / "two.onnx", r"inputs of the ONNX graph: obs, h; expected one input"),
        (damaged, r"damaged\.onnx: cannot be read as ONNX"),
        (tmp_path / "missing.onnx", r"missing\.onnx: cannot be read as ONNX"),
        (tmp_path / "missing.zip", r"missing\.zip: no weights"),
        (write_onnx(wide, tmp_path / "wide.onnx", torch.zeros(1, 3)), r"walk\.onnx: "),
        (lambda x: x, r"policy of type function; expected an Actor"),
        (Actor((), "ELU"), r"gives 2 numbers; expected the 1"),
        (Actor(((np.zeros((1, 2)), np.zeros(1)),), "Swish"), r"activation: 'Swish'; expected one of Tanh"),
        (Actor(((np.zeros((1, 2)), np.full(1, np.nan)),), "Tanh"), r"NaN or infinite"),
    ]
    (tmp_path / "walk.onnx").unlink()
    for policy, words in cases:
        with pytest.raises(PolicyError, match=words) as caught:
            save(policy, envs, tmp_path / "walk.onnx")
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "walk.onnx").exists()
    with pytest.raises(PolicyError, match=r"walk\.zip: expected a name that ends in \.npz or \.onnx"):
        save(nn.Linear(2, 1), envs, tmp_path / "walk.zip")
    with pytest.raises(PolicyError, match=r"walk\.npz: cannot be written"):
        save(nn.Linear(2, 1), envs, tmp_path / "nowhere" / "walk.npz")
    with pytest.raises(PolicyError, match=r"walk\.onnx: cannot be written"):
        save(nn.Linear(2, 1), envs, tmp_path / "nowhere" / "walk.onnx")


@pytest.mark.parametrize("algorithm", ["PPO", "A2C", "SAC", "TD3"])
def test_a_learner_of_stable_baselines3(algorithm: str, envs: Any, tmp_path: Path) -> None:
    small = {"net_arch": [16, 8], "activation_fn": nn.ELU}
    learner = getattr(sb3, algorithm)("MlpPolicy", envs, policy_kwargs=small, device="cpu", seed=0)
    if algorithm in ("PPO", "A2C"):
        learner.policy.action_net.weight.data *= 100  # actions would be small
    actions = learner.predict(OBS, deterministic=True)[0]
    learner.save(tmp_path / "walk.zip")
    for suffix in SUFFIXES if algorithm in ("PPO", "A2C") else (".onnx",):
        assert_acts_as(save(learner, envs, tmp_path / f"model{suffix}"), actions)
    if algorithm in ("PPO", "A2C"):
        assert_acts_as(save(tmp_path / "walk.zip", envs, tmp_path / "archive.npz"), actions)
    else:
        with pytest.raises(PolicyError, match="expected PPO or A2C with MlpPolicy; for others give the loaded model"):
            save(tmp_path / "walk.zip", envs, tmp_path / "archive.npz")


def test_an_actor_beside_a_critic_of_other_observations(tmp_path: Path) -> None:
    envs = make_sb3_vec_env(ID, 2, obs_mode="dict")
    learner = sb3.PPO(AsymmetricPolicy, envs, device="cpu", seed=0)
    learner.policy.action_net.weight.data *= 100
    actions = learner.predict({"policy": OBS, "critic": np.zeros((300, 3), np.float32)}, deterministic=True)[0]
    file = save(learner, envs, tmp_path / "walk.npz")
    assert_acts_as(file, actions)
    assert load_policy(file).record["env_kwargs"] == {"obs_mode": "dict"}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_statistics_of_vecnormalize_become_part_of_the_policy(suffix: str, envs: Any, tmp_path: Path) -> None:
    normalised = VecNormalize(envs, clip_obs=1.5)
    learner = sb3.PPO("MlpPolicy", normalised, device="cpu", seed=0)
    for action in (0.0, 1.0, -1.0):
        normalised.reset()
        normalised.step(np.full((4, 1), action, np.float32))
    learner.policy(torch.zeros(1, 2))  # as in training: the policy keeps tensors with gradients
    learner.policy.action_net.weight.data *= 100
    actions = learner.predict(normalised.normalize_obs(OBS), deterministic=True)[0]
    assert (np.abs(normalised.normalize_obs(OBS)) == 1.5).any()
    learner.save(tmp_path / "walk.zip")
    for policy, env in ((learner, envs), (learner, normalised), (tmp_path / "walk.zip", normalised)):
        assert_acts_as(save(policy, env, tmp_path / f"walk{suffix}"), actions)
    normalised.norm_obs = False
    actions = learner.predict(OBS, deterministic=True)[0]
    assert_acts_as(save(learner, normalised, tmp_path / f"walk{suffix}"), actions)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_wrappers_of_gymnasium(tmp_path: Path) -> None:
    wrappers, module = gymnasium.wrappers.vector, OTHERS["squashed"]()
    options = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "NextStep"}
    native = gymnasium.make_vec(ID, 3, transmission="none", **options)
    normalised = wrappers.NormalizeObservation(wrappers.ClipAction(native))
    normalised.obs_rms.mean, normalised.obs_rms.var = np.array([0.3, -1.0]), np.array([4.0, 0.01])
    scaled = ((OBS - normalised.obs_rms.mean) / np.sqrt(normalised.obs_rms.var + 1e-8)).astype(np.float32)
    source = write_onnx(module, tmp_path / "net.onnx")
    for policy in (module, source):
        assert_acts_as(save(policy, normalised, tmp_path / "walk.onnx"), expected(module, scaled))
    assert load_policy(tmp_path / "walk.onnx").record["env_kwargs"] == {"transmission": "none"}
    twice = wrappers.NormalizeObservation(normalised)
    scaling = wrappers.TransformObservation(native, lambda x: 2 * x, native.single_observation_space)
    for wrapped in (twice, scaling, wrappers.RescaleAction(native, -2.0, 2.0)):
        with pytest.raises(PolicyError, match=f"env: {type(wrapped).__name__} changes observations or actions"):
            save(module, wrapped, tmp_path / "walk.onnx")


def test_all_kinds_of_environments_give_the_same_record(tmp_path: Path) -> None:
    options = {"transmission": "none", "history": 2}
    single = gymnasium.make(ENV, **options)
    batch = gymnasium.make_vec(ENV, 2, num_threads=1, autoreset_mode="SameStep", **options)
    kinds = [single, batch, batch.unwrapped, make_sb3_vec_env(ENV, 2, **options)]
    kinds += [gymnasium.make_vec(ENV, 2, vectorization_mode="sync", **options)]
    kinds += [VecNormalize(DummyVecEnv([lambda: gymnasium.make(ENV, **options)]))]
    actor = Actor(((np.zeros((12, 96)), np.full(12, 0.5)),), "Tanh")
    for env in kinds:
        record = load_policy(save(actor, env, tmp_path / "stand.npz")).record
        assert (record["env"], record["env_kwargs"], record["transmission"]) == (ENV, options, "none")
        assert record["policy_spec"] == single.unwrapped.policy_spec()
        assert (record["observation_size"], record["action_size"]) == (96, 12)


def test_environments_that_cannot_be_recorded(tmp_path: Path) -> None:
    actor = Actor(((np.zeros((1, 2)), np.zeros(1)),), "Tanh")
    cases = [
        (object(), "env of type object: has no registered id"),
        (gymnasium.make("CartPole-v1"), "environment 'CartPole-v1': "),
        (
            gymnasium.make_vec(ID, 2, vectorization_mode="vector_entry_point", extra=print),
            "env: extra: <built-in function print>; expected finite numbers, text",
        ),
    ]
    for env, words in cases:
        with pytest.raises(PolicyError, match=words) as caught:
            save(actor, env, tmp_path / "walk.npz")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_layers_as_arrays_or_lists(suffix: str, envs: Any, tmp_path: Path) -> None:
    weights, bias, last = np.array([[0.1, -0.2], [0.3, 0.2]]), [0.1, -0.1], [[0.5, -0.4]]
    rows = np.array([[0.2, -0.1], [2.0, 3.0], [1.5, 0.5]])
    actor = Actor(((weights, bias), (last, [0.05])), "ReLU", rows)  # type: ignore[arg-type]
    scaled = np.clip((OBS - rows[0]) / rows[1], -rows[2], rows[2])
    actions = np.maximum(scaled @ weights.T + bias, 0) @ np.transpose(last) + 0.05
    assert_acts_as(save(actor, envs, tmp_path / f"walk{suffix}"), np.clip(actions, -1, 1))


def test_a_height_map_is_kept_beside_the_policy(tmp_path: Path) -> None:
    np.save(tmp_path / "hill.npy", np.outer(np.hanning(20), np.ones(12)))
    terrain = {"kind": "map", "file": str(tmp_path / "hill.npy"), "cell": 0.5}
    envs = gymnasium.make_vec(ID, 2, vectorization_mode="vector_entry_point", terrain=terrain)
    (tmp_path / "run").mkdir()
    save(Actor(((np.zeros((1, 2)), np.zeros(1)),), "Tanh"), envs, tmp_path / "run" / "walk.npz")
    assert (tmp_path / "run" / "hill.npy").exists()


def change_data(file: Path, **changes: Any) -> None:
    """Change entries of the member `data` in an archive of Stable-Baselines3."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["data"] = json.dumps(json.loads(members["data"]) | changes).encode()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


class Evil:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def test_damaged_and_hostile_archives_are_one_line(envs: Any, tmp_path: Path) -> None:
    learner, file, done = sb3.PPO("MlpPolicy", envs, device="cpu"), tmp_path / "walk.zip", tmp_path / "done"
    learner.save(file)
    evil = base64.b64encode(pickle.dumps(Evil(done))).decode()
    kwargs = {":type:": "<class 'dict'>", ":serialized:": evil, "activation_fn": "<class 'torch.nn.ReLU'>"}
    change_data(file, policy_kwargs=kwargs, policy_class={":serialized:": evil})
    assert read_actor(save(file, envs, tmp_path / "walk.npz"))[0].activation == "ReLU"
    assert not done.exists()
    for activation in ("<class 'mine.Swish'>", "", 3, None, ["Tanh"]):
        change_data(file, policy_kwargs={"activation_fn": activation})
        with pytest.raises(PolicyError, match=r"walk\.zip: no weights of an actor") as caught:
            save(file, envs, tmp_path / "walk.npz")
        assert "\n" not in str(caught.value)
    for data in ([], "text", {"policy_kwargs": 3}):
        change_data(file, **(data if isinstance(data, dict) else {"policy_kwargs": data}))
        with pytest.raises(PolicyError, match=r"walk\.zip: no weights of an actor"):
            save(file, envs, tmp_path / "walk.npz")
    learner.policy.features_extractor.extra = nn.Linear(2, 2)
    learner.save(file)
    with pytest.raises(PolicyError, match="expected PPO or A2C with MlpPolicy"):
        save(file, envs, tmp_path / "walk.npz")
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(PolicyError, match=r"walk\.zip: no weights of an actor"):
        save(file, envs, tmp_path / "walk.npz")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (np.ones((3, 1)), r"float64 of shape \(3, 1\); expected \(3, 2\)"),
        (np.ones((3, 2), int), "int64 of shape"),
        (np.ones(6), r"of shape \(6,\)"),
        (np.zeros((3, 2)), "positive deviations"),
        (np.full((3, 2), np.nan), "finite means"),
        (np.full((3, 2), np.inf), "finite means"),
    ],
)
def test_normalisation_of_a_strange_file(rows: np.ndarray, words: str, envs: Any, tmp_path: Path) -> None:
    file = save(nn.Linear(2, 1), envs, tmp_path / "walk.npz")
    with np.load(file) as arrays:
        np.savez(tmp_path / "bad.npz", **{**arrays, "normalisation": rows})
    with pytest.raises(PolicyError, match=rf"bad\.npz: normalisation: .*{words}"):
        load_policy(tmp_path / "bad.npz")


def test_an_archive_without_a_record_runs_in_a_named_environment(envs: Any, tmp_path: Path) -> None:
    learner = sb3.PPO("MlpPolicy", envs, device="cpu")
    learner.save(tmp_path / "walk.zip")
    with pytest.raises(PolicyError, match=r"walk\.json: no such file: .*--env ID, or save .* ce_gym\.policies\.save"):
        load_policy(tmp_path / "walk.zip")
    policy = load_policy(tmp_path / "walk.zip", env=ID, env_kwargs={"transmission": "none"})
    assert (policy.record["env"], policy.record["transmission"]) == (ID, "none")
    np.testing.assert_allclose(policy.predict(OBS)[0], learner.predict(OBS, deterministic=True)[0], atol=1e-6)
    with pytest.raises(PolicyError, match="environment 'ce_gym/Nothing-v0': "):
        load_policy(tmp_path / "walk.zip", env="ce_gym/Nothing-v0")
    with pytest.raises(PolicyError, match="a layer takes 2 numbers; expected 48"):
        load_policy(tmp_path / "walk.zip", env=ENV)
