"""Save networks of other libraries as policies."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ce_gym.files import ONNX, write_file
from ce_gym.policies.actor import ACTIVATIONS, Actor
from ce_gym.policies.arguments import RESERVED, checked_arguments
from ce_gym.policies.errors import PolicyError
from ce_gym.policies.files import check_actor, read_sb3_actor, write_npz
from ce_gym.policies.height_maps import keep_map
from ce_gym.policies.onnx_reader import policy_of_onnx
from ce_gym.policies.records import one_line, record_of_id


def save(policy: Any, env: Any, path: str | Path) -> Path:
    """Save a network of any library as a policy, and return the path.

    Commands and `ce_gym.load_policy` take the file. It contains the network and the record of its environment: id,
    arguments, transmission level and specification. Actions outside of -1..1 are clipped.

    Args:
        policy: One of

            - `Actor`: weight and bias of each linear layer, and the name of the activation;
            - a network of torch from observations (n, n_obs) to actions (n, n_actions), also one of TorchScript;
            - a learner of Stable-Baselines3, or the path of its archive (PPO or A2C with `MlpPolicy`);
            - an ONNX model or the path of an ONNX file, with one input.
        env: The environment of training, made by `gymnasium.make`, `make_vec` or `make_sb3_vec_env`, also wrapped.
            Statistics of `VecNormalize` and `NormalizeObservation` become part of the policy.
        path: File to write. `.npz` takes linear layers with one of `ACTIVATIONS` in between, and needs numpy alone to
            run; `.onnx` takes all networks without memory, and needs onnxruntime.

    Raises:
        PolicyError: If the network does not fit the environment, cannot be saved in this format, or would need code
            from a file.

    Examples:
        >>> env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0")
        >>> layers = ((np.zeros((64, 48)), np.zeros(64)), (np.zeros((12, 64)), np.zeros(12)))
        >>> file = ce_gym.policies.save(ce_gym.policies.Actor(layers, "Tanh"), env, "stand.npz")
        >>> ce_gym.load_policy(file).record["env"]
        'ce_gym/MiniCheetahVelocity-v0'
    """
    path = Path(path)
    if path.suffix not in (".npz", ".onnx"):
        raise PolicyError(f"{path}: expected a name that ends in .npz or .onnx")
    record = record_of_id(*_id_and_arguments(env))
    normalisation = _normalisation(getattr(policy, "get_vec_normalize_env", lambda: None)() or env)
    try:
        network = _network(policy, record["observation_size"])
        if isinstance(network, Actor):
            layers = tuple((np.asarray(weight), np.asarray(bias)) for weight, bias in network.layers)
            network = replace(network, layers=layers)
            if normalisation is not None:
                network = replace(network, normalisation=normalisation)
            record["activation"] = network.activation
            check_actor(network, record, path)
        if path.suffix == ".onnx":
            _write_onnx(network, record, normalisation, path)
        elif isinstance(network, Actor):
            write_npz(network, record, path)
        else:
            raise PolicyError(
                f"{path}: the network is not linear layers with one of {', '.join(ACTIVATIONS)} in between; save it "
                "as .onnx"
            )
    except ModuleNotFoundError as error:
        how = f'needs {error.name}, which is not installed: pip install "ce_gym[export]"'
        raise PolicyError(f"{path}: {how}") from None
    keep_map(record["env_kwargs"], path.parent)
    return path


def _network(policy: Any, n_obs: int) -> Any:
    """Return an actor, or an ONNX model.

    Raises:
        PolicyError: If the policy is of another kind or cannot be read.
    """
    if isinstance(policy, str | Path):
        return _read(Path(policy))
    if isinstance(policy, Actor) or type(policy).__name__ == "ModelProto":
        return policy
    if torch := sys.modules.get("torch"):  # imported by the program that made the network
        from ce_gym.policies.torch_networks import MeanAction, network_of

        if isinstance(policy, torch.nn.Module):
            return network_of(policy, n_obs)
        if hasattr(getattr(policy, "policy", None), "_predict"):
            return network_of(MeanAction(policy.policy), n_obs)
    raise PolicyError(
        f"policy of type {type(policy).__name__}; expected an Actor, a torch.nn.Module, a learner of "
        "Stable-Baselines3, an ONNX model, or the path of an .onnx or .zip file"
    )


def _read(file: Path) -> Any:
    """Return the network in an ONNX file or an archive of Stable-Baselines3.

    Raises:
        PolicyError: If the file is of another kind or cannot be read.
    """
    if file.suffix == ".zip":
        return read_sb3_actor(file)
    if file.suffix != ".onnx":
        raise PolicyError(
            f"{file}: expected .onnx or .zip. A file of TorchScript or a pickle runs code when it is loaded: if you "
            f"trust it, load it yourself, as torch.jit.load({file.name!r}), and save the loaded network"
        )
    import onnx

    try:
        return onnx.load(file)
    except Exception as error:  # onnx raises a different class for each kind of damage
        raise PolicyError(f"{file}: cannot be read as ONNX: {one_line(error)}") from None


def _write_onnx(network: Any, record: dict[str, Any], normalisation: NDArray | None, path: Path) -> None:
    """Write a network as ONNX after running it on several observations.

    Raises:
        PolicyError: If the network cannot be run, actions depend on other observations, or the file cannot be written.
    """
    from ce_gym.policies.onnx_writer import complete, to_onnx

    try:
        model = to_onnx(network, record) if isinstance(network, Actor) else complete(network, record, normalisation)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    except Exception as error:  # onnx raises a different class for each kind of damage
        raise PolicyError(f"{path}: the ONNX graph cannot be completed: {one_line(error)}") from None
    content = model.SerializeToString()
    act = policy_of_onnx(content, path).act
    rows = np.random.default_rng(0).standard_normal((8, record["observation_size"]), np.float32)
    if not np.allclose(act(rows), [act(row) for row in rows], rtol=0, atol=1e-4):
        raise PolicyError(f"{path}: actions depend on earlier or other observations; expected a network without memory")
    try:
        write_file(path, content, ONNX)
    except OSError as error:
        raise PolicyError(f"{path}: cannot be written: {error.strerror}") from None


def _id_and_arguments(env: Any) -> tuple[str, dict[str, Any]]:
    """Return the id of an environment, and its arguments without the registered ones.

    Raises:
        PolicyError: If the environment has no id, or an argument is not plain data.
    """
    spec = env.get_attr("spec")[0] if hasattr(env, "get_attr") else getattr(env, "spec", None)
    name = spec.id.rpartition(":")[2] if spec else None  # `make_sb3_vec_env` keeps the module of `module:id`
    if spec is None or name not in gymnasium.registry:
        raise PolicyError(
            f"env of type {type(env).__name__}: has no registered id; expected an environment made by gymnasium.make, "
            "gymnasium.make_vec or make_sb3_vec_env"
        )
    registered = gymnasium.registry[name]
    defaults = {"max_episode_steps": registered.max_episode_steps, **registered.kwargs}
    kwargs = {key: x for key, x in spec.kwargs.items() if key not in RESERVED and key != "num_threads"}
    try:
        plain = json.loads(json.dumps(checked_arguments(kwargs)))
    except ValueError as error:
        raise PolicyError(f"env: {error}; register an environment with this argument") from None
    return spec.id, {key: x for key, x in plain.items() if key not in defaults or defaults[key] != x}


def _layers_of_wrappers(env: Any) -> Iterator[Any]:
    """Iterate over wrappers from outside to inside, then the environment; of several environments, the first."""
    while env is not None:
        yield env
        inner = next((vars(env)[name] for name in ("venv", "env", "envs") if name in vars(env)), None)
        env = inner[0] if isinstance(inner, list | tuple) else inner


def _normalisation(env: Any) -> NDArray | None:
    """Return mean, standard deviation and bound of normalised observations, shape (3, n_obs), or None.

    Raises:
        PolicyError: If a wrapper changes observations or actions in another way.
    """
    found = None
    for wrapper in _layers_of_wrappers(env):
        attributes = vars(wrapper)  # getattr would find attributes of the wrapped environment
        statistics = attributes.get("obs_rms") if attributes.get("norm_obs", True) else None
        statistics = statistics.get("policy") if isinstance(statistics, dict) else statistics
        if statistics is not None and found is None:
            std = np.sqrt(statistics.var + wrapper.epsilon)
            found = np.stack([statistics.mean, std, np.full_like(std, attributes.get("clip_obs", np.inf))])
        elif statistics is not None or _changes(wrapper):
            raise PolicyError(
                f"env: {type(wrapper).__name__} changes observations or actions; expected VecNormalize or "
                "NormalizeObservation at most once: make its function part of the network, and leave the wrapper out"
            )
    return found


def _changes(wrapper: Any) -> bool:
    """Return whether a wrapper of Gymnasium changes observations or actions; environments of ce_gym clip actions."""
    kinds = (gymnasium.ObservationWrapper, gymnasium.ActionWrapper)
    kinds += (gymnasium.vector.VectorObservationWrapper, gymnasium.vector.VectorActionWrapper)
    return isinstance(wrapper, kinds) and type(wrapper).__name__ != "ClipAction"
