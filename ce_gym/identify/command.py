"""The command `python -m ce_gym identify`."""

from __future__ import annotations

import argparse
import os
from typing import Any

from ce_gym.console import add_force_argument, examples, path
from ce_gym.files import ESTIMATES, LOG, PAGE, check_output, write_file
from ce_gym.model.errors import file_error
from ce_gym.model.mechanism import ELASTIC, LEVELS

CONTROLS = ("position", "torque", "motor_position", "motor_torque")
ENCODERS = ("joints", "rotors", "both")
OSCILLATING = {"dt": 1e-3, "high": 20.0}
"""Time between rows [s] and highest frequency [Hz] of simulated logs of elastic transmissions."""


def add_identify_command(subparsers: Any) -> None:
    """Add `identify` to the subcommands of an argument parser."""
    parser = subparsers.add_parser(
        "identify",
        help="estimate rotor inertia, friction and delay from a log of commands and encoders",
        description="Estimate parameters of a robot with a fixed base and its feet in the air from a log, a CSV file "
        "with columns\ntime, command:NAME and angle:NAME. Write a robot file with the estimates, and a page with "
        "measured and simulated curves.",
        epilog=examples(
            "identify mini_cheetah chirps.csv --simulate 60",
            "identify mini_cheetah chirps.csv",
            "identify my_robot.yaml log.csv --control motor_torque --fix link_inertia:hip_link",
            "identify my_robot.yaml log.csv --transmission elastic --substep 0.0005",
        ),
    )
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot, or path of its YAML file")
    parser.add_argument("log", type=path, metavar="LOG", help="a CSV file")
    parser.add_argument(
        "--simulate", type=float, metavar="SECONDS", help="do not estimate: write a simulated LOG of this duration"
    )
    parser.add_argument(
        "--control", choices=CONTROLS, default="position", help="meaning of commands (default position)"
    )
    levels = (*LEVELS, ELASTIC)
    parser.add_argument("--transmission", default="exact", choices=levels, help=f"{', '.join(levels)} (default exact)")
    parser.add_argument("--parameters", nargs="+", metavar="KIND", help="kinds such as rotor_inertia delay")
    parser.add_argument("--fix", nargs="+", default=[], metavar="NAME", help="known parameters")
    parser.add_argument("--window", type=float, default=0.5, metavar="SECONDS", help="length of windows (default 0.5)")
    parser.add_argument("--substep", type=float, default=1e-3, metavar="SECONDS", help="longest step (default 0.001)")
    parser.add_argument(
        "--encoders", choices=ENCODERS, default="joints", help="with --simulate, place of encoders (default joints)"
    )
    parser.add_argument("--out", type=path, metavar="YAML", help="default: beside LOG")
    parser.add_argument("--html", type=path, metavar="FILE", help="default: beside LOG")
    add_force_argument(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run `identify`; return its exit code."""
    from ce_gym.identify.estimate import identify
    from ce_gym.identify.excite import simulate_log
    from ce_gym.identify.log import read_log
    from ce_gym.identify.page import page
    from ce_gym.identify.yaml_output import check_base, report, to_yaml
    from ce_gym.model import RobotError, load_robot

    if args.simulate is not None:
        check_output(args.log, LOG)
        _check_range("--simulate", args.simulate, 1.0, 3600.0)
        options = {"control": args.control, "transmission": args.transmission, "encoders": args.encoders}
        options |= OSCILLATING if args.transmission == ELASTIC else {}
        print(simulate_log(args.robot, args.simulate, **options).save(args.log))
        return 0
    _check_range("--window", args.window, 0.01, 60.0)
    _check_range("--substep", args.substep, 1e-6, 0.1)
    check_base(args.robot)
    load_robot(args.robot)  # its files are then known, and are not replaced
    log = read_log(args.log)
    out, html = args.out or args.log.with_suffix(".yaml"), args.html or args.log.with_suffix(".html")
    for file, kind in ((out, ESTIMATES), (html, PAGE)):
        check_output(file, kind)
    try:
        result = identify(
            args.robot,
            log,
            control=args.control,
            transmission=args.transmission,
            kinds=args.parameters,
            fixed=args.fix,
            window=args.window,
            substep=args.substep,
        )
    except (ValueError, ArithmeticError, MemoryError) as error:  # a fit that fails, in NumPy or SciPy
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"{args.log}: identification failed: {' '.join(str(error).split())[:200]}") from error
    print(report(result))
    base = args.robot
    if base.endswith((".yaml", ".yml")):
        base = os.path.relpath(base, out.resolve().parent)
    write_file(out, to_yaml(result, base), ESTIMATES)
    write_file(html, page(result), PAGE)
    print(f"{out}\n{html}")
    return 0


def _check_range(option: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise file_error("identify", f"{option} {value:g}", f"{low:g} to {high:g} s")
