"""How Sphinx builds this documentation: `make docs`. Pages written from the package itself come from `_ext/`.

A warning is an error (see the Makefile). Packages that are not installed are replaced by stand-ins, so that the pages
can be built without learners and viewers. Knows Sphinx, and `ce_gym` only by name.
"""

from __future__ import annotations

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import numpy.typing  # noqa: E402


class NDArray:
    """In place of numpy's, so that signatures say `NDArray` and not all that this stands for; docstrings say shapes."""

    __module__ = "numpy.typing"

    def __class_getitem__(cls, item: object) -> type:
        return cls


numpy.typing.NDArray = NDArray  # type: ignore[misc,assignment]
numpy.typing.ArrayLike = type("ArrayLike", (), {"__module__": "numpy.typing"})  # type: ignore[misc,assignment]

import ce_gym  # noqa: E402
from ce_gym.dynamics import batched_function  # noqa: E402

batched_function.LONG = 0  # interpret: pages evaluate each quantity of a robot once or twice

project = "ce_gym"
author = copyright = "The ce_gym authors"
version = release = ce_gym.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
extensions += ["generated_pages", "mathml"]
exclude_patterns = ["_build", "records", "exactness.md"]
myst_enable_extensions = ["dollarmath", "amsmath", "attrs_inline"]
myst_heading_anchors = 3

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "ce_gym"
smartquotes = False  # quotes and dashes of commands are pasted into shells
html_static_path = ["_static"]
html_css_files = ["ce_gym.css"]
html_copy_source = html_show_sourcelink = False
pygments_style, pygments_dark_style = "friendly", "github-dark"

# `make links` follows the links of these pages and of README.
linkcheck_timeout, linkcheck_retries, linkcheck_workers = 20, 2, 4
linkcheck_anchors = False  # many sites write theirs by script

# Docstrings are Google's; a name in backticks is code.
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_mock_imports = [
    name
    for name in ("stable_baselines3", "torch", "jax", "rsl_rl", "tensordict", "meshcat", "numba")
    if find_spec(name) is None
]
autodoc_default_options = {"members": True}
napoleon_use_ivar = True
napoleon_use_rtype = False

# Types of other packages, and inner parts of this one, have no pages here.
nitpicky = True
_ELSEWHERE = (
    r"(numpy|np|casadi|ca|gymnasium|torch|stable_baselines3|tensordict|rsl_rl|collections|pathlib|os|typing)\..*"
)
_BARE = (
    r"(NDArray|ArrayLike|Array|Path|PathLike|Mapping|Sequence|Callable|Iterable|Iterator|SX|ca|np|Any|dtype|_F|VecEnv"
)
_BARE += r"|Observations|VecEnvIndices|VecEnvStepReturn|EzPickle|Generic|Env|VectorEnv|Literal.*|optional|float64|bool_"
_BARE += r"|Device)"
_INNER = r"ce_gym\.(sim\.devices|identify\.shooting|envs\.(base|runtime|terms)|model\.mechanism)\..*"
_RECURSION = r"ce_gym\.dynamics\.recursion\..*"
nitpick_ignore_regex = [(r"py:.*", pattern) for pattern in (_ELSEWHERE, _BARE, _INNER, _RECURSION)]


def setup(app: Any) -> None:
    """Show README to the builder that follows links."""

    def add_readme(app: Any, name: str, source: list[str]) -> None:
        if app.builder.name == "linkcheck" and name == app.config.root_doc:
            text = (HERE.parent / "README.md").read_text(encoding="utf-8")
            source[0] += "\n\n" + "\n".join(f"<{url}>" for url in re.findall(r"\]\((https?://[^)\s]+)\)", text))

    app.connect("source-read", add_readme)
