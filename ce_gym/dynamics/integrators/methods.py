"""The time-stepping methods.

The default `EULER` is one linearly implicit step: order 1, stable for stiff contact, friction and gains. The method
`EXTRAPOLATED` makes a whole step and two half steps and extrapolates (Richardson): order 2 for smooth motion, equally
stable, with an error estimate. The method `ADAPTIVE` chooses the length of such steps from the estimate. Runge-Kutta
methods are explicit. They are meant for smooth scenes and for references, because stiff contact limits their step
length.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

from ce_gym.dynamics.integrators.plan import Ends, Plan, Rates, Stage

EULER = Plan(1, (Stage("whole"),), Ends({"whole": 1.0}, {"whole": 1.0}))

# Friction uses the normal force of the previous step, whose error is in proportion to the length of that step. To let
# extrapolation remove the error, the whole step and the half steps each use normal forces of steps of their own length.
EXTRAPOLATED = Plan(
    2,
    (Stage("coarse", load="whole_load"), Stage("half", length=1 / 2), Stage("fine", start="half", length=1 / 2)),
    Ends({"fine": 2.0, "coarse": -1.0}, means={"half": 1 / 2, "fine": 1 / 2}, error=("fine", "coarse")),
)

ADAPTIVE = replace(EXTRAPOLATED, controlled=True)


def runge_kutta(order: int, a: tuple[tuple[float, ...], ...], b: tuple[float, ...]) -> Plan:
    """Return an explicit Runge-Kutta method; reported forces belong to the start of a step.

    Args:
        order: Order of the method.
        a: Coefficients of the stages after the first, one row each.
        b: Weights of the stages.
    """
    rows = ((), *a)
    stages = (Stage(f"stage_{i + 1}", Rates(row), length=0.0, iterations=0) for i, row in enumerate(rows))
    return Plan(order, tuple(stages), Rates(b))


RK4 = runge_kutta(4, ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))
"""The classical method."""

_s = sqrt(21.0)
RK8 = runge_kutta(
    8,
    (
        (1 / 2,),
        (1 / 4, 1 / 4),
        (1 / 7, (-7 - 3 * _s) / 98, (21 + 5 * _s) / 49),
        ((11 + _s) / 84, 0.0, (18 + 4 * _s) / 63, (21 - _s) / 252),
        ((5 + _s) / 48, 0.0, (9 + _s) / 36, (-231 + 14 * _s) / 360, (63 - 7 * _s) / 80),
        (
            (10 - _s) / 42,
            0.0,
            (-432 + 92 * _s) / 315,
            (633 - 145 * _s) / 90,
            (-504 + 115 * _s) / 70,
            (63 - 13 * _s) / 35,
        ),
        (1 / 14, 0.0, 0.0, 0.0, (14 - 3 * _s) / 126, (13 - 3 * _s) / 63, 1 / 9),
        (1 / 32, 0.0, 0.0, 0.0, (91 - 21 * _s) / 576, 11 / 72, (-385 - 75 * _s) / 1152, (63 + 13 * _s) / 128),
        (
            *(1 / 14, 0.0, 0.0, 0.0, 1 / 9, (-733 - 147 * _s) / 2205, (515 + 111 * _s) / 504),
            *((-51 - 11 * _s) / 56, (132 + 28 * _s) / 245),
        ),
        (
            *(0.0, 0.0, 0.0, 0.0, (-42 + 7 * _s) / 18, (-18 + 28 * _s) / 45, (-273 - 53 * _s) / 72),
            *((301 + 53 * _s) / 72, (28 - 28 * _s) / 45, (49 - 7 * _s) / 18),
        ),
    ),
    (1 / 20, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 49 / 180, 16 / 45, 49 / 180, 1 / 20),
)
"""Cooper and Verner (1972), eleven stages: the reference for smooth motion."""

METHODS: dict[str, Plan] = {
    "euler": EULER,
    "extrapolated": EXTRAPOLATED,
    "adaptive": ADAPTIVE,
    "rk4": RK4,
    "rk8": RK8,
}
"""All methods, by the name that `Simulator(method=...)` takes."""
