"""The setup of a live page: policy, transmission levels and ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import environment_of, find_policy, load_policy, shipped_policies
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.live.robot import UNDISTURBED, Act, LiveRobot

GROUNDS: Mapping[str, Mapping[str, Any]] = {
    "flat": {"kind": "flat"},
    **{kind: {"kind": kind, "curriculum": False, "levels": 2} for kind in ("slope", "rough", "stairs")},
}
"""Arguments `terrain` by name: half of the field is level, the other half has the task's slope, roughness or stairs."""


@dataclass(frozen=True)
class Setup:
    """A policy on a robot at one or two transmission levels.

    Attributes:
        policy: A file, a folder or the name of a shipped policy; "" holds the standing pose.
        env_id: Registered environment id; "" for the environment of the training.
        transmission: Level of the robot; "" for the level of the training.
        ghost: Level of the ghost; "" for no ghost.
        terrain: Ground, one of `GROUNDS`; "" for the ground of the training.
        kwargs: Further arguments of the environment, in place of the training's.

    Raises:
        ViewerError: Policy and environment are missing, or an argument is unknown or set by the page itself.
    """

    policy: str = ""
    env_id: str = ""
    transmission: str = ""
    ghost: str = ""
    terrain: str = ""
    kwargs: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.policy and not self.env_id:
            raise ViewerError("nothing to show: expected a policy or an environment")
        for name, known in (("transmission", LEVELS), ("ghost", LEVELS), ("terrain", tuple(GROUNDS))):
            if getattr(self, name) not in ("", *known):
                raise ViewerError(f"{name}={getattr(self, name)!r}; expected one of {', '.join(known)}")
        for name in self.kwargs:
            if name in UNDISTURBED or name == "randomise":
                raise ViewerError(f"{name}: expected another argument; the page sets this one")

    def changed(self, changes: Mapping[str, str]) -> Setup:
        """Return the setup with some attributes replaced; a new policy brings its own environment."""
        env_id = self._policy()[1] if changes.get("policy") == "" else "" if "policy" in changes else self.env_id
        return replace(self, **{"env_id": env_id, **changes})

    def robots(self) -> list[LiveRobot]:
        """Make the robot and its ghost, with a compilation if the cache lacks their kernels.

        Raises:
            PolicyError: The policy's file is missing, damaged or of another robot.
            ViewerError: The environment cannot be made.
        """
        act, env_id, kwargs = self._policy()
        if self.terrain:
            kwargs["terrain"] = GROUNDS[self.terrain]
        levels = [self.transmission or kwargs.get("transmission", LEVELS[0]), *([self.ghost] if self.ghost else [])]
        return [LiveRobot(env_id, act, **{**kwargs, "transmission": level}) for level in levels]

    def _policy(self) -> tuple[Act | None, str, dict[str, Any]]:
        if not self.policy:
            return None, self.env_id, dict(self.kwargs)
        policy = load_policy(self.policy, env=self.env_id, env_kwargs=self.kwargs)
        env_id = environment_of(policy.record, self.env_id or None)
        kwargs = {**policy.record["env_kwargs"], **self.kwargs}
        return (lambda observation: policy.predict(observation)[0]), env_id, kwargs


def named(name: str, env_id: str = "", **options: Any) -> Setup:
    """Return the setup for the name of a policy or the id of an environment."""
    is_id = name.rpartition("-v")[2].isdecimal()
    if is_id and find_policy(name) is None:
        return Setup(env_id=env_id or name, **options)
    return Setup(policy=name, env_id=env_id, **options)


def policies_for(robot: str, also: Sequence[str] = ()) -> list[str]:
    """Return the policies that a page offers for a robot: `also`, then the shipped policies."""
    shipped = [name for name in shipped_policies() if name.startswith(f"{robot}_")]
    return list(dict.fromkeys([*(name for name in also if name), *shipped]))
