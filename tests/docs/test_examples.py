"""Examples in docstrings say what really comes out, and the names that people use first have one.

Every module with a `>>>` is looked at. Examples know `ce_gym`, `gymnasium` and `np`, and the names of their module;
they run in an empty folder.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import ce_gym
import ce_gym.viewer

PACKAGE = Path(ce_gym.__file__).parent
MODULES = [
    ".".join(("ce_gym", *path.relative_to(PACKAGE).with_suffix("").parts))
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]
LEARNERS = {"ce_gym.adapters.sb3": "stable_baselines3"}
"""What a module needs that may be missing."""
USED_FIRST = (
    ce_gym.Model, ce_gym.Model.forward_dynamics, ce_gym.Simulator, ce_gym.Terrain, ce_gym.environment_ids,
    ce_gym.load_policy, ce_gym.load_robot, ce_gym.register_robot, ce_gym.robots, ce_gym.viewer.Rollout.save,
    ce_gym.viewer.record,
)  # fmt: skip


def examples(module: str) -> list[doctest.DocTest]:
    """Return the docstrings with examples of a module."""
    known = {"ce_gym": ce_gym, "gymnasium": gymnasium, "np": np}
    found = doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module), extraglobs=known)
    return [one for one in found if one.examples]


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_examples_give_what_they_say(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if module in LEARNERS and find_spec(LEARNERS[module]) is None:
        pytest.skip(f"{LEARNERS[module]} is not installed")
    monkeypatch.chdir(tmp_path)
    ids = set(gymnasium.registry)
    report: list[str] = []
    try:
        found = examples(module)
        assert found, f"{module}: has >>> where doctest finds none"
        for one in found:
            assert len(one.examples) <= 6, f"{one.name}: an example is short"
            doctest.DocTestRunner(verbose=False).run(one, out=report.append)
    finally:  # others count ids
        for env_id in set(gymnasium.registry) - ids:
            del gymnasium.registry[env_id]
    assert not report, "".join(report)


@pytest.mark.parametrize("thing", USED_FIRST, ids=lambda thing: thing.__qualname__)
def test_what_is_used_first_has_an_example(thing: Callable):
    assert ">>> " in (inspect.getdoc(thing) or "")
