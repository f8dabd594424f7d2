"""Write an installable package with one robot, one task, settings of training, a test, and a workflow for GitHub.

The folder `template` has its files. In names and contents, `my_lab` is replaced by the name of the package, and `MyLab`
by the name in camel case. The robot is a copy of Mini Cheetah.
"""

from __future__ import annotations

import keyword
import re
from pathlib import Path

from ce_gym.envs.registration import camel_case
from ce_gym.learn.runs.settings import CONFIG_FOLDER
from ce_gym.model.arguments import check
from ce_gym.model.assets import assets_folder

TEMPLATE = Path(__file__).with_name("template")
NAME = "my_lab"
ROBOT = "mini_cheetah"
SUFFIX = ".template"
"""Ending of template files that tools would otherwise take for files of this repository."""


def write_project(name: str, folder: Path) -> list[Path]:
    """Write the package into an empty or new folder.

    Args:
        name: Name of the package: lower-case letters, digits and underscores.
        folder: Folder of the project.

    Returns:
        The files, relative to the folder.

    Raises:
        ValueError: The name cannot be the name of a package.
        OSError: The folder exists and is not empty, or cannot be written.
    """
    allowed = re.fullmatch(r"[a-z][a-z0-9_]*", name) and not keyword.iskeyword(name) and name != "ce_gym"
    check("name", name, allowed, "lower-case letters, digits and underscores, as in my_lab")
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder}: is not empty; expected a new folder")

    def named(text: str) -> str:
        return text.replace(NAME, name).replace(camel_case(NAME), camel_case(name))

    texts = {
        named(path.relative_to(TEMPLATE).as_posix().removesuffix(SUFFIX)): named(path.read_text(encoding="utf-8"))
        for path in sorted(TEMPLATE.rglob(f"*{SUFFIX}"))
    }
    for kind in ("urdf", "yaml"):
        text = (assets_folder() / ROBOT / f"{ROBOT}.{kind}").read_text(encoding="utf-8")
        text = re.sub(rf'^(name: |urdf: |<robot name="){ROBOT}', rf"\g<1>{name}_robot", text, flags=re.MULTILINE)
        texts[f"src/{name}/{name}_robot.{kind}"] = text
    settings = (CONFIG_FOLDER / "default.yaml").read_text(encoding="utf-8").partition("\n")[2]
    texts[f"src/{name}/crouch.yaml"] = f"# Settings of PPO for the task crouch.\n{settings}"
    for file, text in texts.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return [Path(file) for file in texts]
