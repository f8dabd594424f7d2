"""Policies on the command line of the viewer: a small file with weights is run, and what it does is recorded.

The file, `policy.npz`, is written by train/card.py: `weight_0`, `bias_0`, ... of the actor and `record`, JSON that says
which environment the policy is for. It is read and run by numpy alone, and nothing in it is unpickled. Knows
environments by their ids, and recorders.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model import assets_folder
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.recorder import Recorder
from ce_gym.viewer.rollout import Rollout

Act = Callable[[Any], NDArray[np.float32]]
"""Actions (n, n_actions) for observations (n, n_obs), or a dictionary that has these as "policy"."""

Script = Sequence[tuple[float, tuple[float, float, float]]]
"""Commands one after the other: for how long [s], then forward, lateral [m/s] and yaw rate [rad/s]."""

SHOW: Script = (
    (1.0, (0.0, 0.0, 0.0)),
    (4.0, (0.8, 0.0, 0.0)),
    (4.0, (0.5, 0.0, 1.0)),
    (3.0, (0.0, 0.4, 0.0)),
    (4.0, (1.0, 0.0, 0.0)),
    (1.0, (0.0, 0.0, 0.0)),
)
"""Stand, walk, turn, step sideways, walk faster, stand."""

ACTIVATIONS: Mapping[str, Callable[[NDArray], NDArray]] = {
    "Tanh": np.tanh,
    "ReLU": lambda x: np.maximum(x, 0),
    "ELU": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}
"""By their names in torch.nn."""


def drive(act: Act, env_id: str, script: Script = SHOW, *, seed: int = 0, label: str = "", **kwargs: Any) -> Rollout:
    """Drive one environment through a list of commands and record every step.

    Recording ends with the script, or with the episode should the robot fall.

    Args:
        act: The policy.
        env_id: Registered environment id.
        script: What to command.
        seed: Of the environment.
        label: A few words for the viewer's legend.
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        One frame per step of the environment.
    """
    import gymnasium

    # Commands come from the script: the environment draws no new ones before the end of time.
    options = {**kwargs, "contact_forces": True, "command_period": 1e6}
    envs = gymnasium.make_vec(env_id, 1, vectorization_mode="vector_entry_point", **options)
    try:
        native: Any = envs.unwrapped
        period = 1.0 / native.metadata["render_fps"]
        commands = np.repeat([c for _, c in script], [round(t / period) for t, _ in script], axis=0)
        robot, level = native.model.robot.name, native.model.transmission
        recorder = Recorder(robot, level, period, label=label, contact_names=native.contact_names)
        observation, _ = envs.reset(seed=seed)
        for step, command in enumerate(commands):
            native.set_command(command)
            state = native.state()
            recorder.add(step * period, *(state[name][0] for name in ("q", "v", "contact_forces", "command")))
            observation, _, terminated, truncated, _ = envs.step(act(observation))
            if terminated[0] or truncated[0]:
                break
        return recorder.rollout()
    finally:
        envs.close()


def policy_file(path: Path) -> Path | None:
    """Return the policy that a path means: a file, a folder that has one, or the name of one that is shipped."""
    shelf = assets_folder() / "policies"
    folders = [path, *([shelf / path, shelf / f"{path}_exact"] if len(path.parts) == 1 and not path.suffix else [])]
    candidates = [*(folder / "policy.npz" for folder in folders), *([path] if path.name == "policy.npz" else [])]
    return next((file for file in candidates if file.is_file()), None)


def walk(file: Path) -> Rollout:
    """Run a policy through `SHOW` in the environment it was trained in.

    Raises:
        ViewerError: If the file is damaged or no policy.
    """
    import ce_gym  # noqa: F401  (its environments)

    act, record = read_policy(file)
    return drive(act, record["env"], label=file.parent.name, **record["env_kwargs"])


def read_policy(file: Path) -> tuple[Act, dict[str, Any]]:
    """Return a policy's mean action, clipped to [-1, 1], and its record.

    Raises:
        ViewerError: If the file is damaged or no policy.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            record = json.loads(str(arrays["record"]))
            n = sum(name.startswith("weight_") for name in arrays.files)
            layers = [(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(n)]
        activate = ACTIVATIONS[record["activation"]]
        if missing := {"env", "env_kwargs"} - record.keys():
            raise KeyError(*sorted(missing))
        sizes = [int(record["observation_size"]), *(len(bias) for _, bias in layers)]
    except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ViewerError(f"{file}: not a policy that can be run: {' '.join(str(error).split())}") from None
    if any(weight.shape != (len(bias), size) for (weight, bias), size in zip(layers, sizes, strict=False)):
        raise ViewerError(f"{file}: not a policy that can be run: its layers do not fit each other")

    def act(observation: Any) -> NDArray[np.float32]:
        x = observation["policy"] if isinstance(observation, Mapping) else observation
        for i, (weight, bias) in enumerate(layers):
            x = (activate(x) if i else x) @ weight.T + bias
        return np.clip(x, -1.0, 1.0).astype(np.float32)

    return act, record
