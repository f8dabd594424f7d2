"""The program of a kernel against the same plan unrolled into one expression, for every method."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym import Model, Simulator, Terrain
from ce_gym.compile import Call, Lookup, calls_of
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import Rates
from ce_gym.dynamics.laws.scene_laws import iterations_needed
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import (
    Body,
    ContactMaterial,
    ContactSphere,
    Gains,
    Inertial,
    Joint,
    LinearConstraint,
    Motor,
    Placement,
    Robot,
)
from ce_gym.sim.substeps import substeps

OUTPUTS = ("torque", "motor_speed", "power", "contact_forces", "energy")


def hopper() -> Robot:
    """A block with a foot on a driven leg, light enough for its motor to be at its limit."""

    def inertial(mass: float, moment: float) -> Inertial:
        return Inertial(mass, (0.0, 0.0, 0.0), tuple(map(tuple, np.diag([moment] * 3).tolist())))

    block = Body("block", "link", None, Placement(), Joint("free"), inertial(2.0, 0.01))
    joint = Joint("revolute", (0.0, 1.0, 0.0), torque=1.0, damping=0.01)
    leg = Body("leg", "link", "block", Placement(), joint, inertial(0.1, 1e-4))
    rotor = Body("leg_rotor", "rotor", "block", Placement(), Joint("revolute", (0.0, 1.0, 0.0)), inertial(0.01, 1e-6))
    gear = LinearConstraint("gear", (("leg_rotor", 1.0), ("leg", -1.0)))
    contacts = tuple(ContactSphere(f"corner_{x}", "block", (0.1 * x, 0.0, -0.05), 0.01) for x in (-1, 1))
    contacts += (ContactSphere("foot", "leg", (0.05, 0.0, -0.05), 0.01),)
    gains, motors = Gains((("leg", 8.0),), (("leg", 0.1),)), (Motor("leg_rotor", 1.0, 40.0),)
    return Robot(
        "hopper",
        (block, leg, rotor),
        (gear,),
        ("leg",),
        contacts=contacts,
        motors=motors,
        gains=gains,
        material=ContactMaterial(2e4, 100.0, 0.6),
    )


def start(count: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and targets of robots that fall to the ground, sliding."""
    rng = np.random.default_rng(0)
    q = np.tile([0.0, 0.0, 0.062, 1.0, 0.0, 0.0, 0.0, 0.0], (count, 1))
    q[:, 2] += rng.uniform(-0.004, 0.01, count)
    return q, rng.normal(0, 1.0, (count, 7)), rng.normal(0, 1.0, (count, 1))


@pytest.mark.parametrize("method", [name for name, plan in METHODS.items() if not plan.controlled])
def test_kernel_and_expression_are_one_step(method: str):
    """Iterated or not, to rounding, state and outputs, until the robots lie on the ground."""
    model, plan = Model(hopper()), METHODS[method]
    dt = 0.005 if not isinstance(plan.end, Rates) else 2e-4
    outputs = (*OUTPUTS, "error") if plan.estimates else OUTPUTS
    q, v, target = start()
    sim = Simulator(model, len(q), dt, method=method, motors="limited", outputs=outputs, retry=0)
    sim.set_state(q, v)
    function = step_function(model.mechanism, sim.options, outputs)
    names = ("q", "v", "load", "whole_load", "anchor", "diverged")
    names = tuple(name for name in names if name in function.name_in())
    state = {name: sim._read(name) for name in names}
    for _ in range(12):
        sim.step(target)
        for i in range(len(q)):
            result = function(target=target[i], dt=dt, **{name: state[name][i] for name in names})
            result = {name: value.full().ravel() for name, value in result.items()}
            for name in names:
                np.testing.assert_allclose(sim._read(name)[i], result[f"{name}_next"], rtol=1e-8, atol=1e-8)
            for name in outputs:
                got = sim._read(name)[i]
                np.testing.assert_allclose(got, result[name], rtol=1e-6, atol=1e-6, err_msg=name)
        state = {name: sim._read(name) for name in names}  # a step at a time: contacts amplify rounding
    assert (sim.contact_forces[..., 2] > 0).any()


@pytest.mark.parametrize("method", METHODS)
def test_stages_are_iterated_and_look_up_where_they_start(method: str):
    """As data says: iterations follow the first of each stage, a look-up goes before each new place."""
    model = Model(hopper())
    options = StepOptions(0.005, contacts=model.contact_names, method=method, ground="field")
    _, _, steps = substeps(model.mechanism, options, ())
    calls = list(calls_of(steps))
    plan, most = METHODS[method], iterations_needed(model.mechanism, options)
    iterations = [c for c in calls if isinstance(c, Call) and c.function.name() == "iteration"]
    staged = [stage for stage in plan.stages if stage.iterations]
    assert len(iterations) == sum(1 + min(stage.iterations, most) for stage in staged)
    assert sum(not call.only_if for call in iterations) == len(staged)
    under = [c for c in calls if isinstance(c, Lookup) and c.points == "places"]
    assert len(under) == (len({stage.start for stage in staged}) if staged else 1)


def test_terrain_is_looked_up_under_the_second_half():
    """A step of the extrapolated method on a field that is flat is the step on flat ground."""
    model, (q, v, target) = Model(hopper()), start()
    ends = []
    for terrain in (None, Terrain.flat()):
        sim = Simulator(model, len(q), 0.005, method="extrapolated", motors="limited", terrain=terrain, outputs=OUTPUTS)
        sim.set_state(q, v)
        sim.step(target)
        ends.append(sim.v)
    np.testing.assert_allclose(*ends, rtol=1e-9, atol=1e-9)
