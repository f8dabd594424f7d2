"""Joint torque error of simplified transmissions while a leg tracks a sinusoid (the paper's tracking experiment).

The experiment is defined by the authors of the constraint-embedding paper, ROAM-Lab-ND/generalized_rbda branch v0.1.0,
Benchmarking/src/accuracyBenchmarkEndEffectorTracking.cpp. Every joint follows 0.5 sin(2 pi 1.5 t) rad for 5 s on a
fixed base, sampled at 0.5 ms. The simplified models have no rotors ("unconstrained"), or the diagonal of their
reflected inertia ("approximate"). The paper's values of 4.31 and 1.04 N m belong to the knee coordinate, which the
paper calls the ankle.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot

AMPLITUDE = 0.5
FREQUENCY = 1.5
STEP = 5e-4
SAMPLES = 10001
SIMPLIFIED = {"none": "unconstrained", "armature": "approximate"}
PUBLISHED = {("none", "knee_link"): 4.3096, ("armature", "knee_link"): 1.0446}
"""Root mean square error of the knee, computed with the authors' program [N m]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mit_humanoid_leg", help="name or path of a robot with a fixed base")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    joints, exact, errors = torque_errors(arguments.robot)
    peak = np.abs(exact).max(axis=0)
    columns = ("joint", "largest exact [N m]", *(f"rms {SIMPLIFIED[level]} [N m]" for level in errors))
    columns += tuple(f"{SIMPLIFIED[level]} / largest [%]" for level in errors)
    rows = []
    for i, joint in enumerate(joints):
        rms = [float(error[i]) for error in errors.values()]
        rows.append((joint, float(peak[i]), *rms, *(100.0 * x / float(peak[i]) for x in rms)))
    report = Report("tracking", [Table("Torque error against exact transmissions", columns, tuple(rows))])
    for (level, joint), expected in PUBLISHED.items():
        if joint in joints:
            measured = float(errors[level][joints.index(joint)])
            claim = f"{joint} rms {SIMPLIFIED[level]}, the paper's experiment gives {expected} N m"
            report.requirements.append(Requirement(claim, f"{measured:.6f}", abs(measured - expected) <= 5e-5))
    return report


def torque_errors(name: str) -> tuple[list[str], NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Return joint names, exact torques [N m], shape (n_samples, n_joints), and rms errors by level, (n_joints,)."""
    robot = load_robot(name)
    exact = Model(robot, transmission="exact")
    q, v, vdot = sinusoid(exact.nv)
    torque = exact.inverse_dynamics(q, v, vdot)
    errors = {}
    for level in SIMPLIFIED:
        simplified = Model(robot, transmission=level, locked_rotors=False)
        errors[level] = np.sqrt(np.mean((simplified.inverse_dynamics(q, v, vdot) - torque) ** 2, axis=0))
    return list(exact.joint_links), torque, errors


def sinusoid(
    n: int, frequency: float = FREQUENCY, amplitude: float = AMPLITUDE
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return positions [rad], speeds [rad/s] and accelerations [rad/s^2] of n joints, each of shape (n_samples, n)."""
    t = (np.arange(SAMPLES) * STEP)[:, None]
    w = 2.0 * np.pi * frequency
    same = np.full((1, n), amplitude)
    return np.sin(w * t) * same, w * np.cos(w * t) * same, -(w**2) * np.sin(w * t) * same
