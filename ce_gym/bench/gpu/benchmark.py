"""GPU: agreement with the CPU, registers, sub-steps and environment steps per second, MuJoCo Warp.

Without a GPU the benchmark compares the emitted source, run on the CPU, and reports registers from the run-time
compiler. The other measurements are listed as not measured, with the reason. Each table is also printed to the standard
error stream as soon as it is complete.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

from ce_gym.bench.gpu import agreement as gpu_agreement
from ce_gym.bench.gpu import speed as gpu_speed
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.compile.cuda import CudaUnavailable, nvrtc
from ce_gym.compile.cuda.source import BLOCK, emit_source
from ce_gym.console import progress
from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.batch import programs
from ce_gym.envs.runtime.setup import make_program
from ce_gym.model import robots
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim import Simulator
from ce_gym.sim.devices import Device, Emulated, device_named

DTYPES = ("float32", "float64")
ARCHITECTURES = ("sm_80", "sm_90")
BATCHES = (4096, 16384, 65536, 262144, 1048576)
PARTS = ("agreement", "resources", "substeps", "environment", "warp")
REQUIRED = {"sub-steps": 1e9, "environment": 200e6, "warp": 50.0}
"""Required sub-steps and environment steps per second, and ratio of speeds to MuJoCo Warp."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robots", nargs="*", default=robots(), help="robots whose agreement is measured")
    parser.add_argument("--levels", nargs="+", default=LEVELS, choices=LEVELS, help="and their levels")
    parser.add_argument("--robot", default="mini_cheetah", help="robot that is timed")
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES, help="sizes of batches that are timed")
    parser.add_argument("--num-envs", type=int, default=256, help="robots of a batch whose agreement is measured")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS, help="what is measured")
    parser.add_argument("--compile-only", dest="parts", action="store_const", const=PARTS[1:2], help="only resources")
    parser.add_argument("--rounds", type=int, default=5, help="how often each is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    report, missing = Report("gpu", tables=_Tables()), list[tuple[str, str, str]]()
    device, reason = _device()
    report.machine["GPU"] = gpu_speed.name_of(device) if not reason else f"none: {reason}"
    where = "on the GPU" if not reason else "emitted source run by the CPU"
    if "agreement" in arguments.parts:
        try:
            gpu_agreement.measure(arguments.robots, arguments.levels, arguments.num_envs, device, where, report)
        except RuntimeError as problem:  # neither a GPU nor a C++ compiler
            missing.append(("agreement with the CPU", "1e-11 and 1e-5", str(problem)))
    if "resources" in arguments.parts:
        try:
            report.tables.append(_resources(arguments.robot))
        except CudaUnavailable as problem:
            missing.append(("registers, spills, occupancy", "", str(problem)))
    _speed(arguments, device, reason, report, missing)
    if missing:
        report.tables.append(Table("NOT MEASURED", ("what", "required", "why"), tuple(missing)))
    return report


class _Tables(list[Table]):
    """Tables that are printed when they are added, because a run may be cut off."""

    def append(self, table: Table) -> None:
        """Add and print a table."""
        super().append(table)
        print(f"{table.as_text()}\n", file=sys.stderr, flush=True)


def _device() -> tuple[Device, str]:
    """Return the GPU, or a replacement on the CPU with the reason."""
    try:
        return device_named("cuda"), ""
    except ValueError as problem:
        return Emulated(), str(problem)


def _speed(
    arguments: argparse.Namespace, device: Device, reason: str, report: Report, missing: list[tuple[str, str, str]]
) -> None:
    """Add the rates on a GPU, or remarks that they were not measured, to the report."""
    required = {name: f"{figure:,.0f}" for name, figure in REQUIRED.items()}
    rows: dict[str, tuple[str, str, Callable[..., None]]] = {
        "substeps": ("sub-steps/s, exact, feet on the ground, best batch", required["sub-steps"], _substeps),
        "environment": ("environment steps/s, exact, best batch", required["environment"], _environment),
        "warp": ("times as fast as MuJoCo Warp", required["warp"], _warp),
    }
    for what, bar, measure in progress([row for part, row in rows.items() if part in arguments.parts], "measurements"):
        if reason:
            missing.append((what, bar, reason))
            continue
        try:
            measure(arguments, device, report)
        except (gpu_speed.Unmeasured, ImportError) as problem:
            missing.append((what, bar, str(problem)))


def _substeps(arguments: argparse.Namespace, device: Device, report: Report) -> None:
    rates = gpu_speed.substeps(arguments.robot, device, arguments.batches, DTYPES, arguments.rounds)
    report.tables.append(gpu_speed.rate_table(f"Sub-steps/s, {arguments.robot} exact, feet on the ground", rates))
    _require(report, "sub-steps", "sub-steps/s in the best batch", rates)


def _environment(arguments: argparse.Namespace, device: Device, report: Report) -> None:
    rates = gpu_speed.environment(arguments.robot, device, arguments.batches, DTYPES, arguments.rounds)
    report.tables.append(gpu_speed.rate_table(f"Environment steps/s, {arguments.robot} exact, velocity task", rates))
    _require(report, "environment", "environment steps/s in the best batch", rates)


def _warp(arguments: argparse.Namespace, device: Device, report: Report) -> None:
    from ce_gym.bench.gpu import warp as gpu_warp

    theirs = gpu_warp.rates(arguments.robot, arguments.batches, arguments.rounds)
    ours = gpu_speed.substeps(arguments.robot, device, arguments.batches, ("float32",), arguments.rounds)
    report.tables.append(gpu_speed.rate_table("Sub-steps/s, single precision, ours and MuJoCo Warp", ours | theirs))
    ratio = max(max(r.values()) for r in ours.values()) / max(max(r.values()) for r in theirs.values())
    claim = f"at least {REQUIRED['warp']:g} times as fast as MuJoCo Warp, best batch of either"
    report.requirements.append(Requirement(claim, f"{ratio:.1f}", ratio >= REQUIRED["warp"]))


def _require(report: Report, what: str, claim: str, rates: dict[str, dict[int, float]]) -> None:
    best = max(rate for by_batch in rates.values() for rate in by_batch.values())
    report.requirements.append(
        Requirement(f"at least {REQUIRED[what]:,.0f} {claim}", f"{best:,.0f}", best >= REQUIRED[what])
    )


class _Stages(Emulated):
    """Device that stores the stages of the last kernel and compiles nothing."""

    def kernel(self, key: str, build: Any, dtype: str) -> Any:
        """Build the stages; return a kernel with buffers only."""
        self.stages = tuple(build())
        self.source = emit_source(self.stages, dtype)
        self.buffers = {b.name: b for b in self.source.layout.buffers}
        return self


def _resources(robot: str) -> Table:
    """Return registers and memory of the kernels on GPU architectures, from the run-time compiler, without a GPU."""
    program = make_program(robot, "velocity")
    rows = []
    for dtype in DTYPES:
        caught = _Stages()
        Simulator(Model(robot), device=caught, dtype=dtype, contacts="foot", outputs=())
        sources = {"sub-steps": caught.source, "environment step": emit_source(programs(program, caught), dtype)}
        for name, source in sources.items():
            for arch in ARCHITECTURES:
                start = time.perf_counter()
                code, used = nvrtc.compile_cubin(source.text, arch)
                seconds = time.perf_counter() - start
                share = 100 * used.occupancy(arch, BLOCK)
                figures = (used.registers, used.stack, used.spill_stores, used.spill_loads, share)
                rows.append((name, dtype, arch, source.threads, *figures, round(len(code) / 1024), seconds))
    columns = ("kernel", "dtype", "for", "threads of a robot", "registers", "stack [B]", "spill stores [B]")
    columns += ("spill loads [B]", "occupancy [%]", "code [KiB]", "compile [s]")
    title = f"What a thread takes, {robot} exact, by NVRTC {nvrtc.compiler_version()}, blocks of {BLOCK}"
    return Table(title, columns, tuple(rows))
