"""Identification of rotor inertia, friction, delay and link inertia from logs of commands and encoders."""

from ce_gym.identify.estimate import identify
from ce_gym.identify.excite import chirps, simulate_log
from ce_gym.identify.log import Log, LogError, read_log
from ce_gym.identify.page import page
from ce_gym.identify.parameters import Parameter
from ce_gym.identify.result import Identified
from ce_gym.identify.yaml_output import report, to_yaml

__all__ = [
    "Identified",
    "Log",
    "LogError",
    "Parameter",
    "chirps",
    "identify",
    "page",
    "read_log",
    "report",
    "simulate_log",
    "to_yaml",
]
