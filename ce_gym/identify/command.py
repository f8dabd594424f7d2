"""The command `python -m ce_gym identify`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from ce_gym.console import examples
from ce_gym.model.mechanism import ELASTIC, LEVELS

CONTROLS = ("position", "torque", "motor_position", "motor_torque")
ENCODERS = ("joints", "rotors", "both")
OSCILLATING = {"dt": 1e-3, "high": 20.0}
"""Rows [s] and highest frequency [Hz] of simulated logs of transmissions that stretch."""


def add_identify_command(subparsers: Any) -> None:
    """Add `identify` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "identify",
        help="estimate rotor inertia, friction and delay from a log of commands and encoders",
        description="Estimate figures of a robot that hangs in the air, its base held, from a log: a CSV file with "
        "columns time,\ncommand:NAME and angle:NAME. Write a robot file with them, and a page of measured and "
        "simulated curves.",
        epilog=examples(
            "identify mini_cheetah chirps.csv --simulate 60",
            "identify mini_cheetah chirps.csv",
            "identify my_robot.yaml log.csv --control motor_torque --fix link_inertia:hip_link",
            "identify my_robot.yaml log.csv --transmission elastic --substep 0.0005",
        ),
    )
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot, or path of its YAML file")
    parser.add_argument("log", type=Path, metavar="LOG", help="a CSV file")
    parser.add_argument(
        "--simulate", type=float, metavar="SECONDS", help="write LOG instead, of the robot under chirps"
    )
    parser.add_argument("--control", choices=CONTROLS, default="position", help="what commands mean (default position)")
    levels = (*LEVELS, ELASTIC)
    parser.add_argument("--transmission", default="exact", choices=levels, help=f"{', '.join(levels)} (default exact)")
    parser.add_argument("--figures", nargs="+", metavar="KIND", help="what to seek, such as rotor_inertia delay")
    parser.add_argument("--fix", nargs="+", default=[], metavar="NAME", help="figures that are known")
    parser.add_argument("--window", type=float, default=0.5, metavar="SECONDS", help="pieces of the log (default 0.5)")
    parser.add_argument("--substep", type=float, default=1e-3, metavar="SECONDS", help="longest step (default 0.001)")
    parser.add_argument(
        "--encoders", choices=ENCODERS, default="joints", help="with --simulate, where they are (default joints)"
    )
    parser.add_argument("--out", type=Path, metavar="YAML", help="default: beside LOG")
    parser.add_argument("--html", type=Path, metavar="FILE", help="default: beside LOG")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run `identify`; return its exit code."""
    from ce_gym.identify.estimate import identify
    from ce_gym.identify.excite import simulate_log
    from ce_gym.identify.log import read_log
    from ce_gym.identify.overlay import check_base, overlay, report
    from ce_gym.identify.page import page

    if args.simulate is not None:
        _check_new("LOG", args.log, [Path(args.robot)])
        _check_range("--simulate", args.simulate, 1.0, 3600.0)
        known = {"control": args.control, "transmission": args.transmission, "encoders": args.encoders}
        known |= OSCILLATING if args.transmission == ELASTIC else {}
        print(simulate_log(args.robot, args.simulate, **known).save(args.log))
        return 0
    _check_range("--window", args.window, 0.01, 60.0)
    _check_range("--substep", args.substep, 1e-6, 0.1)
    out, shown = args.out or args.log.with_suffix(".yaml"), args.html or args.log.with_suffix(".html")
    for option, file in (("--out", out), ("--html", shown)):
        _check_new(option, file, [Path(args.robot), args.log])
    check_base(args.robot)
    found = identify(
        args.robot,
        read_log(args.log),
        control=args.control,
        transmission=args.transmission,
        kinds=args.figures,
        fixed=args.fix,
        window=args.window,
        substep=args.substep,
    )
    print(report(found))
    base = args.robot
    if base.endswith((".yaml", ".yml")):
        base = os.path.relpath(base, out.resolve().parent)
    out.write_text(overlay(found, base), encoding="utf-8")
    shown.write_text(page(found), encoding="utf-8")
    print(f"{out}\n{shown}")
    return 0


def _check_new(option: str, file: Path, read: list[Path]) -> None:
    """Refuse to write over what is read."""
    from ce_gym.model import RobotError

    if any(file.resolve() == other.resolve() for other in read):
        raise RobotError(f"identify: {option} {file}: would replace what is read; expected another name")


def _check_range(option: str, value: float, low: float, high: float) -> None:
    from ce_gym.model import RobotError

    if not low <= value <= high:
        raise RobotError(f"identify: {option} {value:g}: expected {low:g} to {high:g} s")
