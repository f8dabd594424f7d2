"""Laws of the normal force of a contact, one class each; `NORMAL_LAWS` names them.

With depth `d` and normal velocity `v_n`, out of the ground:

    lam = k d - (c + dt k) v_n   (Kelvin-Voigt)        lam = k d+ (1 - h v_n)+   (Hunt-Crossley, linearised)

The dissipation `h` takes the place of the damping `c`, which has no part in the second law.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Compliance, NormalLaw, Touch
from ce_gym.model.description import ContactMaterial


class KelvinVoigt:
    """A spring and a damper side by side."""

    def force(self, touch: Touch, compliance: Compliance, dt: float) -> tuple[SX, SX]:
        """Return the force [N] at no velocity and its slope [N s/m]."""
        return compliance.stiffness * touch.depth, compliance.damping + dt * compliance.stiffness


class HuntCrossley:
    """A spring whose force grows with the rate of compression, so that it starts from nothing at the surface."""

    def force(self, touch: Touch, compliance: Compliance, dt: float) -> tuple[SX, SX]:
        """Return the force [N] at no velocity and its slope [N s/m].

        Raises:
            ValueError: The material has no dissipation.
        """
        c, h, v_n = compliance, compliance.dissipation, ca.dot(touch.normal, touch.velocity)
        if h is None:
            raise ValueError("normal_law='hunt_crossley'; expected a material with a dissipation")
        rate = c.stiffness * ca.fmax(0, 1 - h * v_n)
        growth = ca.if_else(v_n < 1 / h, c.stiffness * h * ca.fmax(touch.depth, 0), 0)
        return rate * touch.depth + growth * v_n, dt * rate + growth


NORMAL_LAWS: dict[str, NormalLaw] = {"kelvin_voigt": KelvinVoigt(), "hunt_crossley": HuntCrossley()}
"""All laws, by the name that `Simulator(normal_law=...)` takes."""


def normal_law(name: str | None, material: ContactMaterial) -> NormalLaw:
    """Return a law by name; for None, Hunt and Crossley's law if the material has a dissipation."""
    return NORMAL_LAWS[name or ("kelvin_voigt" if material.dissipation is None else "hunt_crossley")]
