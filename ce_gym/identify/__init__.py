"""Figures of a robot from logs of commands and encoders: rotor inertia, friction, delay, link inertia."""

from ce_gym.identify.estimate import identify
from ce_gym.identify.excite import chirps, simulate_log
from ce_gym.identify.figures import Figure
from ce_gym.identify.found import Identified
from ce_gym.identify.log import Log, LogError, read_log
from ce_gym.identify.overlay import overlay, report
from ce_gym.identify.page import page

__all__ = [
    "Figure",
    "Identified",
    "Log",
    "LogError",
    "chirps",
    "identify",
    "overlay",
    "page",
    "read_log",
    "report",
    "simulate_log",
]
