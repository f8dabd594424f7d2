"""The transmission report in words: `transmission_report(model)`."""

from __future__ import annotations

from ce_gym.diagnostics.transmission import (
    ACCELERATION_SPREAD,
    POSITION_SPREAD,
    SPEED_SPREAD,
    ClusterFigures,
    LevelError,
    RotorFigures,
    Spread,
    TransmissionReport,
    report_transmissions,
)
from ce_gym.dynamics.model import Model
from ce_gym.model.table import Cell, table_text

DROPPED = {
    "exact": "nothing",
    "coupled": "reaction of spinning rotors on their carriers, gyroscopic torque",
    "armature": "that, and the off-diagonal reflected inertia",
    "none": "that, and the diagonal reflected inertia",
}


def transmission_report(model: Model, states: int = 200) -> str:
    """Return what the transmissions of a robot are and what each level drops of them, as plain text.

    Args:
        model: Any model of the robot; its level does not matter.
        states: Number of random states in which the levels are compared; zero leaves the comparison out.
    """
    return as_text(report_transmissions(model, states))


def as_text(report: TransmissionReport) -> str:
    """Return a report as plain text."""
    if not report.clusters:
        return f"{report.robot} has no rotors: all transmission levels are the same."
    parts = [
        "Rotors: speed for unit speed of the joints",
        table_text(
            ("rotor", "carried by", "ratio", "inertia [kg m^2]", "symmetric"),
            [_rotor_row(rotor) for cluster in report.clusters for rotor in cluster.rotors],
        ),
        *_on_unknown(report),
        "",
        "Reflected inertia G_r^T J G_r [kg m^2], and its share of the joint's whole inertia",
        _reflected_table(report.clusters),
    ]
    if report.without_rotors:
        parts += ["", f"Without rotors: {', '.join(report.without_rotors)}"]
    return "\n".join([*parts, "", *_level_lines(report)])


def _on_unknown(report: TransmissionReport) -> list[str]:
    if all(rotor.known for cluster in report.clusters for rotor in cluster.rotors):
        return []
    return [
        "  unknown: the robot's file gives the reflected inertia but no gear ratio, so `exact` equals `coupled` there;",
        "  `gears:` in a YAML file gives the ratio.",
    ]


def _rotor_row(rotor: RotorFigures) -> tuple[Cell, ...]:
    symmetric, carrier = "yes" if rotor.symmetric else "no", rotor.carrier or "world"
    if not rotor.known:
        return rotor.name, carrier, "unknown", "unknown", symmetric
    terms = [f"{'-' if ratio < 0 else '+'} {abs(ratio):.4g} {joint}" for joint, ratio in rotor.ratios.items()]
    return rotor.name, carrier, " ".join(terms).removeprefix("+ "), rotor.inertia, symmetric


def _reflected_table(clusters: tuple[ClusterFigures, ...]) -> str:
    width = max(len(cluster.joints) for cluster in clusters)
    rows: list[tuple[Cell, ...]] = []
    for cluster in clusters:
        for joint, line, share in zip(cluster.joints, cluster.reflected, cluster.share, strict=True):
            cells = [f"{x:.7f}" for x in line] + [None] * (width - len(line))
            rows.append((joint, f"{100 * share:.1f} %", *cells))
    blanks = [""] * (width - 1)
    return table_text(("joint", "share", "row of the matrix", *blanks), rows)


def _level_lines(report: TransmissionReport) -> list[str]:
    if not report.errors:
        return ["What each level drops", table_text(("level", "drops"), list(DROPPED.items()))]
    nothing = Spread(0.0, 0.0)
    floating = report.errors[0].base is not None
    columns = ["level", "drops", "joints, median", "max"]
    if floating:
        columns += ["base, median", "max"]
    rows: list[list[Cell]] = []
    for error in (LevelError("exact", nothing, nothing if floating else None), *report.errors):
        spreads = (error.joints, error.base) if error.base else (error.joints,)
        rows.append([error.level, DROPPED[error.level], *(cell for s in spreads for cell in _percents(s))])
    return [
        f"What each level drops, and its error |vdot - vdot_exact| / |vdot_exact| over {report.states} random states",
        table_text(columns, rows),
        f"  States: joints within {POSITION_SPREAD} of the standing pose, velocities N(0, {SPEED_SPREAD}), forces for",
        f"  accelerations N(0, {ACCELERATION_SPREAD}), no wrench on a floating base.",
    ]


def _percents(spread: Spread) -> tuple[str, str]:
    return _percent(spread.median), _percent(spread.max)


def _percent(x: float) -> str:
    return f"{100 * x:.0f} %" if x >= 1.0 else f"{100 * x:.3g} %"
