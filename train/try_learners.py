"""Let other people's learners train for a minute each, and say whether they learn.

Each is installed in a virtual environment of its own and runs its own script, or the few lines in `train/others/`,
on a standing robot whose returns are watched (`train/others/watched.py`). What cannot be installed is skipped.

    python train/try_learners.py
    python train/try_learners.py torchrl skrl --seconds 120
"""

from __future__ import annotations

import interruption  # noqa: F401

# isort: split

import argparse
import os
import subprocess
import sys
import time
import venv
from pathlib import Path
from site import getsitepackages

import numpy as np
from console import Parser, above_zero, add_json_argument, print_result, run

HERE = Path(__file__).parent
WATCHED = "watched:watched/Stand-v0"
SMALL = ["--env", WATCHED, "--steps", "1e9", "--set", "num_envs=64", "rollout=64"]
ZOO = ["-m", "rl_zoo3.train", "--algo", "ppo", "--env", "watched/Stand-v0", "--gym-packages", "watched", "-f", "logs"]
LEARNERS = {
    "rl_zoo": (["rl_zoo3"], [*ZOO, "--conf-file", str(HERE / "others" / "rl_zoo.yml")]),
    "sbx": (["sbx-rl"], ["others/sbx_ppo.py"]),
    "tianshou": (["tianshou[eval]>=2"], ["others/tianshou_ppo.py"]),
    "torchrl": (["torchrl"], ["others/torchrl_ppo.py"]),
    "torchrl_vector": (["torchrl"], ["others/torchrl_ppo.py", "--vector"]),
    "skrl": (["skrl[torch]"], ["others/skrl_ppo.py"]),
    "rsl_rl": (["ce_gym[train]", "rsl-rl-lib>=5.5,<6", "onnx"], ["rsl_rl_ppo.py", *SMALL]),
    "rllib": (["ray[rllib]>=2.60", "torch", "onnx"], ["rllib.py", *SMALL, "--env-runners", "0"]),
    "ppo": (["ce_gym[train]"], ["ppo.py", *SMALL]),
    "fast_ppo": (["ce_gym[fast]"], ["fast_ppo.py", *SMALL]),
}
"""What is installed for each learner, and what Python then runs in this folder."""

PATIENCE = 600.0
"""Longest time until the first episode ends [s]: imports and compilation come before."""


class Missing(Exception):
    """A learner that cannot be installed; the message is one line."""


def python_of(folder: Path, packages: list[str], shared: bool) -> Path:
    """Return the interpreter of a virtual environment that has packages, made if it is not there.

    Args:
        folder: Of the environment.
        packages: For pip.
        shared: Whether packages of the interpreter that runs this are seen, too, so that less is downloaded.

    Raises:
        Missing: If they cannot be installed.
    """
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    done = folder / "installed"
    if done.exists():
        return python
    venv.create(folder, with_pip=True, symlinks=os.name != "nt")
    if shared:
        (own,) = folder.glob("lib/python*/site-packages")
        seen = f"import site; [site.addsitedir(folder) for folder in {getsitepackages()!r}]\n"
        (own / "shared.pth").write_text(seen, encoding="utf-8")
    root = str(HERE.parent)
    named = [name.replace("ce_gym", root, 1) if name.startswith("ce_gym[") else name for name in packages]
    command = [str(python), "-m", "pip", "install", "--quiet", root, *named]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        errors = [line for line in finished.stderr.splitlines() if line.startswith("ERROR")]
        raise Missing((errors or [f"pip ended with {finished.returncode}"])[-1])
    done.touch()
    return python


def train(python: Path, words: list[str], seconds: float, out: Path) -> tuple[list[float], str]:
    """Run a learner for so long after its first episode; return the returns of all, and its last words if it ended."""
    out.mkdir(parents=True, exist_ok=True)
    file, log = out / "returns.txt", out / "log.txt"
    file.write_text("", encoding="utf-8")
    path = os.pathsep.join([str(HERE / "others"), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "WATCHED_FILE": str(file.resolve()), "PYTHONPATH": path}
    words = [str(HERE / word) if word.endswith(".py") else word for word in words]
    with log.open("w", encoding="utf-8") as told:
        process = subprocess.Popen([str(python), *words], cwd=out, env=environment, stdout=told, stderr=told)
        try:
            begun, first = time.monotonic(), None
            while process.poll() is None:
                time.sleep(0.2)
                first = first or (time.monotonic() if file.stat().st_size else None)
                if time.monotonic() - (first or begun) > (seconds if first else PATIENCE):
                    break
            ended = process.poll() is not None
        finally:
            process.kill()
            process.wait()
    last = (log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["nothing"])[-1]
    return [float(line) for line in file.read_text().splitlines()], last if ended else ""


def progress(returns: list[float]) -> tuple[float, float]:
    """Return the means of the first and the last tenth of episodes; not numbers if there are fewer than twenty."""
    if len(returns) < 20:
        return float("nan"), float("nan")
    tenth = len(returns) // 10
    return float(np.mean(returns[:tenth])), float(np.mean(returns[-tenth:]))


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Install learners, each in an environment of its own, and see whether they learn.")
    parser.add_argument("learners", nargs="*", metavar="LEARNER", help=f"{', '.join(LEARNERS)} (default: all)")
    parser.add_argument("--seconds", type=above_zero, default=60.0, metavar="T", help="to train each (default 60)")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/learners"), metavar="FOLDER", help="for all that is made"
    )
    parser.add_argument("--shared", action="store_true", help="see packages of the Python that runs this as well")
    add_json_argument(parser)
    args = parser.parse_args(argv)
    if unknown := set(args.learners) - set(LEARNERS):
        parser.error(f"{min(unknown)!r}: expected some of {', '.join(LEARNERS)}")
    return run("try_learners.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Try every learner asked for; 1 if one was installed and did not learn."""
    results = {}
    for name in args.learners or LEARNERS:
        packages, words = LEARNERS[name]
        try:
            python = python_of(args.out.resolve() / f"venv_{name.split('_vector')[0]}", packages, args.shared)
        except Missing as error:
            results[name] = {"skipped": f"not installable: {error}"}
        else:
            returns, problem = train(python, words, args.seconds, args.out.resolve() / name)
            before, after = progress(returns)
            results[name] = {"episodes": len(returns), "before": before, "after": after, "problem": problem}
        print(line(name, results[name]), file=sys.stderr, flush=True)
    print_result(results, "\n".join(line(name, result) for name, result in results.items()), args.json)
    tried = [result for result in results.values() if "skipped" not in result]
    return int(not all(result["after"] > result["before"] for result in tried))


def line(name: str, result: dict) -> str:
    """What came of one learner."""
    if "skipped" in result:
        return f"{name:<15} skipped: {result['skipped']}"
    told = f"return from {result['before']:.2f} to {result['after']:.2f} over {result['episodes']} episodes"
    return f"{name:<15} {told}" + (f"; ended: {result['problem'][:200]}" if result["problem"] else "")


if __name__ == "__main__":
    raise SystemExit(main())
