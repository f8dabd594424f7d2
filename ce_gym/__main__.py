"""The command `python -m ce_gym`: lists and inspects robots, shows policies and rollouts, identifies, benchmarks.

This file only parses arguments. A subcommand imports its code when it runs, so that `--help` is instant. Errors that a
user can fix are one line on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from ce_gym.console import InputError, Parser, add_force_argument, examples, file_error, path, print_anything
from ce_gym.files import guarded, set_force
from ce_gym.identify.command import add_identify_command
from ce_gym.learn.commands.evaluate import (
    add_card_command,
    add_evaluate_command,
    add_sim2sim_command,
    add_transfer_command,
)
from ce_gym.learn.commands.export import add_export_command
from ce_gym.learn.commands.train import add_train_command
from ce_gym.policies import add_env_arg, import_module_of
from ce_gym.viewer.cli import add_live_command, add_play_command, add_view_command, add_watch_command

WELCOME = """ce_gym: Gymnasium environments for legged robots with exact transmission dynamics.

  python -m ce_gym list                  robots, environments and trained policies
  python -m ce_gym new my_robot.urdf     write the YAML file that a robot of one's own needs, guesses marked
  python -m ce_gym project my_lab        write a package with a robot and a task of one's own
  python -m ce_gym inspect mini_cheetah  clusters and gears of a robot, errors of each transmission level
  python -m ce_gym view my_robot.urdf    move the joints of a robot in a browser; contacts, frames, inertias
  python -m ce_gym inspect ENVIRONMENT   scalar operations of an environment's step, feature by feature
  python -m ce_gym train ENVIRONMENT     train a policy
  python -m ce_gym evaluate POLICY       errors, falls, motors and pushes of a policy
  python -m ce_gym transfer POLICY       a policy on every transmission level
  python -m ce_gym sim2sim POLICY        a policy in MuJoCo
  python -m ce_gym export POLICY         write a policy as ONNX, for a robot's computer
  python -m ce_gym card RUN              evaluate a trained policy completely, and write its card
  python -m ce_gym play POLICY           let a trained policy act, and show it in a browser
  python -m ce_gym live POLICY           drive, push and throw it in a browser
  python -m ce_gym watch RUN             see how training goes: curves, and the present policy
  python -m ce_gym view walk.npz         show recorded rollouts, several side by side or as ghosts
  python -m ce_gym identify ROBOT LOG    rotor inertia, friction, delay from a log of commands and encoders
  python -m ce_gym bench                 benchmarks, in a clone of the repository

Each has --help. In Python: gymnasium.make("ce_gym:ce_gym/MiniCheetahVelocity-v0")."""


READER_NOTES = ("left out: ", "joint ", "link ")
"""Beginnings of the notes that readers of files add to the notes of a robot's file."""
MOST_NOTES = 8


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, or 2 for an error that the user can fix."""
    print_anything()
    argv = sys.argv[1:] if argv is None else list(argv)
    if not argv:
        print(WELCOME)
        return 0
    return run(lambda: _run(argv))


def run(work: Callable[[], int]) -> int:
    """Do the work of a command and return its exit code: 2 after an error that the user can fix, 130 after Ctrl-C."""
    try:
        with warnings.catch_warnings(), guarded():
            shown: set[str] = set()
            warnings.showwarning = lambda message, *_, **__: _show_once(str(message), shown)
            return work()
    except KeyboardInterrupt:
        print("ce_gym: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if not _can_be_mended(error):
            raise
        print(f"ce_gym: {file_error(error) if isinstance(error, OSError) else error}", file=sys.stderr)
        return 2


def _run(argv: list[str]) -> int:
    if argv[0] == "bench":  # has its own parser, so its options must not meet ours
        return _bench(argv[1:])
    args = _parser().parse_args(argv)
    set_force(getattr(args, "force", False))
    return args.run(args)


def _show_once(message: str, shown: set[str]) -> None:
    """Print a warning that has not been shown yet."""
    if message not in shown:
        shown.add(message)
        print(f"ce_gym: warning: {message}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="python -m ce_gym", description=WELCOME)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    list_ = commands.add_parser(
        "list", help="robots, environments and policies", description="List robots, environments and trained policies."
    )
    list_.set_defaults(run=_list)
    inspect = commands.add_parser(
        "inspect",
        help="print the structure of a robot, or the operations of an environment's step",
        description="Print the clusters and gears of a robot and the errors of each transmission level, or the "
        "scalar operations\nof an environment's step, feature by feature.",
        epilog=examples(
            "inspect mini_cheetah",
            "inspect my_robot.yaml --levels",
            "inspect ce_gym/TelloVelocity-v0",
            "inspect ce_gym/TelloVelocity-v0 --env-arg terrain=stairs",
        ),
    )
    inspect.add_argument("name", metavar="NAME", help="name of a robot, path of its file, or id of an environment")
    inspect.add_argument(
        "--transmission", default="exact", metavar="LEVEL", help="exact (default), coupled, armature, none or elastic"
    )
    add_env_arg(inspect)
    inspect.add_argument("--no-errors", action="store_true", help="robot: do not compare the levels in random states")
    inspect.add_argument("--levels", action="store_true", help="robot: print only the errors of the simplified levels")
    inspect.add_argument(
        "--no-standing", action="store_true", help="robot: do not simulate whether it stands without a policy"
    )
    inspect.set_defaults(run=_inspect)
    new = commands.add_parser(
        "new",
        help="start a robot of one's own from its URDF or MJCF file",
        description="Write a commented YAML file beside a URDF or MJCF file, with feet, trunk, standing pose, torque\n"
        "limits, gains and commands guessed and marked, and a picture, and say how to go on.",
        epilog=examples("new my_robot.urdf", "new my_robot.xml --out mine.yaml"),
    )
    new.add_argument("file", type=path, metavar="FILE", help="a URDF or MJCF file")
    new.add_argument(
        "--out", type=path, metavar="YAML", help="the file to write; by default beside FILE, ending in .yaml"
    )
    add_force_argument(new)
    new.set_defaults(run=_new)
    project = commands.add_parser(
        "project",
        help="write a package with a robot and a task of one's own",
        description="Write an installable package with a robot, a task, settings of training, a test and a workflow\n"
        "for GitHub. `import ce_gym` registers its robots and tasks in every process.",
        epilog=examples("project my_lab", "project my_lab --out ~/my_lab"),
    )
    project.add_argument("name", metavar="NAME", help="name of the package, such as my_lab")
    project.add_argument("--out", type=path, metavar="FOLDER", help="a new folder; by default NAME")
    project.set_defaults(run=_project)
    add_train_command(commands)
    add_evaluate_command(commands)
    add_transfer_command(commands)
    add_sim2sim_command(commands)
    add_export_command(commands)
    add_card_command(commands)
    add_play_command(commands)
    add_view_command(commands)
    add_live_command(commands)
    add_watch_command(commands)
    add_identify_command(commands)
    commands.add_parser("bench", help="benchmarks, in a clone of the repository; without a name, the list of them")
    return parser


def _list(args: argparse.Namespace) -> int:
    import gymnasium

    from ce_gym import environment_ids, shipped_policies
    from ce_gym.model.formats.motor_library import motor_table
    from ce_gym.model.load import robot_table

    names = [name for name in environment_ids() if name.count("-") == 1]
    print(f"Robots:\n{robot_table()}\n")
    print('Environments; "-Armature" before "-v0" has that level, and `transmission` selects others:')
    print("\n".join(f"  {name}" for name in names))
    others = [name for name in gymnasium.registry if name.startswith("ce_gym/") and name not in environment_ids()]
    if others := [name for name in others if name.count("-") == 1]:
        print("Environments of other packages:")
        print("\n".join(f"  {name}" for name in others))
    print(f"\nMotors, for `use` in robot files; figures at the rotor:\n{motor_table()}")
    print("\nPolicies, for `play`:")
    print("\n".join(f"  {name}" for name in shipped_policies()))
    return 0


def _new(args: argparse.Namespace) -> int:
    from ce_gym.envs.custom import id_stem, missing, zero_limits
    from ce_gym.model import RobotError
    from ce_gym.new_robot.picture import write_picture
    from ce_gym.new_robot.robot_file import write_new_robot

    path, robot, guessed = write_new_robot(args.file, args.out)
    guesses = path.read_text(encoding="utf-8").count("GUESS") - 1
    if write_picture(path.with_suffix(".png"), robot):
        print(f"{path.with_suffix('.png')}: a picture with contacts, and axes of the base and the feet")
    print(f"{path}: {len(robot.independent)} joints, {len(robot.contacts)} contact spheres, {guesses} lines of guesses")
    for problem in (*missing(robot), *guessed.warnings):
        print(f"  check: {problem}")
    for line in zero_limits(robot):
        print(f"  {line}")
    try:
        stem = id_stem(robot)
    except RobotError as error:
        print(f"  {error}")
        return 0
    print(
        f"Go through the file; then\n  python -m ce_gym inspect {path}\n"
        "and, to train, with a module that registers it:\n"
        f"  echo 'import ce_gym; ce_gym.register_robot(\"{path}\")' > my_robots.py\n"
        f"  PYTHONPATH=. python -m ce_gym train my_robots:{stem}Velocity-v0"
    )
    return 0


def _project(args: argparse.Namespace) -> int:
    from ce_gym.envs.registration import camel_case
    from ce_gym.new_project.project import write_project

    folder = args.out or Path(args.name)
    try:
        files = write_project(args.name, folder)
    except ValueError as error:
        raise InputError(str(error)) from None
    print("\n".join(f"{folder / file}" for file in files))
    print(
        f"Then\n  pip install -e {folder}\n"
        f"  python -m ce_gym train ce_gym/{camel_case(args.name)}RobotCrouch-v0 "
        f"--config {folder / 'src' / args.name / 'crouch.yaml'}"
    )
    return 0


def _inspect(args: argparse.Namespace) -> int:
    from ce_gym.diagnostics.levels import levels_report
    from ce_gym.diagnostics.robot import robot_report
    from ce_gym.diagnostics.standing import seconds_to_compile, standing_report
    from ce_gym.diagnostics.transmission import transmission_report
    from ce_gym.dynamics import Model
    from ce_gym.envs.custom import missing, zero_limits

    if re.search(r"-v\d+$", args.name) and not args.name.endswith((".yaml", ".urdf", ".xml")):
        return _inspect_environment(args)
    model = Model(args.name, transmission=args.transmission)
    if args.levels:
        print(levels_report(model))
        return 0
    print(f"{model.describe()}\n\n{robot_report(model)}\n", flush=True)
    problems = missing(model.robot)
    notes = [note for note in model.robot.notes if note.startswith(READER_NOTES)]
    print("".join(f"{note}\n" for note in notes[:MOST_NOTES]), end="")
    if len(notes) > MOST_NOTES:
        print(f"and {len(notes) - MOST_NOTES} more in `Robot.notes`")
    print("".join(f"Joints have {line}\n" for line in zero_limits(model.robot)), flush=True)
    print("Environments: it has what every task needs\n" if not problems else "Environments lack:")
    print("".join(f"  {problem}\n" for problem in problems), flush=True)
    if model.robot.gains.kp and not (problems or args.no_standing):
        if (seconds := seconds_to_compile(model)) > 5:
            told = f"letting it stand compiles a kernel of about {seconds:.0f} s once"
            print(f"ce_gym: {told}; --no-standing omits that", file=sys.stderr, flush=True)
        print(f"{standing_report(model)}\n", flush=True)
    print(transmission_report(model, states=0) if args.no_errors else transmission_report(model))
    return 0


def _inspect_environment(args: argparse.Namespace) -> int:
    from ce_gym.diagnostics.scene import scene_report
    from ce_gym.model import RobotError

    try:
        print(scene_report(import_module_of(args.name), **dict(args.env_args)))
    except ImportError as error:
        raise RobotError(f"environment {args.name!r}: {error}") from error
    except ValueError as error:
        raise RobotError(str(error)) from error
    return 0


def _bench(argv: list[str]) -> int:
    if importlib.util.find_spec("ce_gym.bench") is None:
        print("ce_gym: benchmarks are not installed with the package; run them in a clone of it", file=sys.stderr)
        return 2
    from ce_gym.bench.__main__ import main as bench

    return bench(argv)


def _can_be_mended(error: Exception) -> bool:
    from ce_gym.model import RobotError
    from ce_gym.policies import PolicyError
    from ce_gym.viewer import RolloutError, ViewerError

    return isinstance(error, (InputError, RobotError, PolicyError, RolloutError, ViewerError, OSError))


if __name__ == "__main__":
    sys.exit(main())
