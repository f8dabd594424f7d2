"""Where exactness matters: controllers, contacts and designs made on simplified levels, judged on exact."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from ce_gym.bench.exactness.protocol import LEVEL_SEED
from ce_gym.bench.measure.report import Report

STUDIES = ("controllers", "contacts", "designs")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("study", choices=STUDIES, help="which study")
    parser.add_argument("--quick", action="store_true", help="a small part of it, without pictures: a minute")
    parser.add_argument("--seed", type=int, default=LEVEL_SEED, help="of poses and noise")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where tables and pictures go")


def run(arguments: argparse.Namespace) -> Report:
    """Run one study."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    study = importlib.import_module(f"ce_gym.bench.exactness.{arguments.study}")
    return study.run(arguments, arguments.out)
