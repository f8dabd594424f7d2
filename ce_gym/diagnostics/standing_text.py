"""Whether a robot stands without a policy, in words: part of `python -m ce_gym inspect ROBOT`."""

from __future__ import annotations

from ce_gym.diagnostics.standing import FACTORS, SECONDS, StandingReport, report_standing
from ce_gym.dynamics.model import Model

LARGEST_GAP = 0.01
"""Between the lowest contact and the ground in the standing pose, from which the report says so [m]."""


def standing_report(model: Model) -> str:
    """Return whether a robot's position gains carry it, and if not, what would, as plain text.

    Args:
        model: Of a robot that tasks can have.
    """
    return as_text(report_standing(model))


def as_text(report: StandingReport) -> str:
    """Return a report as plain text."""
    if report.after is None:
        lines = [f"Without a policy: stands {SECONDS:g} s by its gains, targets held at the standing pose"]
    else:
        lines = [f"Without a policy: falls within {report.after:.1f} s, targets held at the standing pose."]
        lines += _what_would_carry(report)
    if abs(report.gap) > LARGEST_GAP:
        side = "above" if report.gap > 0 else "below"
        lines.append(
            f"  In the standing pose its lowest contact is {abs(report.gap):.3f} m {side} the ground: check `pose`."
        )
    if report.contacts < report.of_contacts:
        lines.append(f"  Simulated with {report.contacts} of its {report.of_contacts} contacts: {report.which}.")
    return "\n".join(lines)


def _what_would_carry(report: StandingReport) -> list[str]:
    lines = [f"  {_times('All position gains', report.factor)}"]
    if not report.ankles:
        return lines
    lines.append(f"  {_times('Those of ' + ', '.join(report.ankles) + ' alone', report.ankle_factor)}")
    if report.toppling <= 0:
        lines.append("  Its centre of mass is below these joints, so they do not hold it up as ankles do.")
    elif report.stiffness == 0:
        lines.append("  None of these joints turns about the lateral axis, so their gains do not hold it in pitch.")
    else:
        lines.append(
            f"  Weight times height above these joints is {report.toppling:.3g} N m/rad; their gains hold "
            f"{report.stiffness:.3g} against it."
        )
    return lines


def _times(gains: str, factor: float | None) -> str:
    if factor is None:
        return f"{gains} would not carry it, not even times {FACTORS[-1]:g}."
    return f"{gains} times {factor:g} would carry it."
