"""The equations of one robot, traced over CasADi SX: kinematics, CE-ABA, CE-RNEA, contact, time stepping."""

from ce_gym.dynamics.model import Model

__all__ = ["Model"]
