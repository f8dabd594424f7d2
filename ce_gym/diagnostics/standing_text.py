"""Whether a robot stands without a policy, in words: part of `python -m ce_gym inspect ROBOT`."""

from __future__ import annotations

from ce_gym.diagnostics.standing import FACTORS, SECONDS, StandingReport, report_standing
from ce_gym.dynamics.model import Model


def standing_report(model: Model) -> str:
    """Return whether a robot's position gains carry it, and if not, what would, as plain text.

    Args:
        model: Of a robot that tasks can have.
    """
    return as_text(report_standing(model))


def as_text(report: StandingReport) -> str:
    """Return a report as plain text."""
    if report.after is None:
        return f"Without a policy: stands {SECONDS:g} s by its gains, targets held at the standing pose"
    lines = [
        f"Without a policy: falls within {report.after:.1f} s, targets held at the standing pose.",
        f"  All position gains times {_times(report.factor)} would carry it.",
    ]
    if report.ankles:
        lines += [
            f"  Those of {', '.join(report.ankles)} alone times {_times(report.ankle_factor)}.",
            f"  Weight times height above these joints is {report.toppling:.3g} N m/rad; their gains hold "
            f"{report.stiffness:.3g} against it.",
        ]
    return "\n".join(lines)


def _times(factor: float | None) -> str:
    return f"(none up to {FACTORS[-1]:g})" if factor is None else f"{factor:g}"
