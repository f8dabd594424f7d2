"""Only what is near: an iteration of the light scene where nothing else can touch in the step, else of the full one.

Contacts that are declared to be seldom, and pairs of links, are left out of the light scene. Which of the two a robot
makes follows from its own state alone, so that no result depends on its neighbours in a tile; a tile makes both if its
robots differ. Near is what is within a margin of the other, or would be within two steps at the speed at which it
approaches; what gets a speed from elsewhere in the step that takes it further begins to act in the step after it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.recursion.kinematics import outward_velocity_pass
from ce_gym.dynamics.stepping.step import iterate_size, meeting_pairs, touching
from ce_gym.dynamics.stepping.trace import Given, iteration_function
from ce_gym.model.mechanism import Mechanism

MARGIN = 0.01
"""What is nearer than this is near [m]."""
STEPS = 2.0
"""What comes as near as that within so many steps at the speed that it has is near, too."""
PER_CONTACT = {"load": 1, "anchor": 2, "ground": 3, "places": 2, "contact_forces": 3}
"""What has so many numbers for each contact."""


def light(options: StepOptions) -> StepOptions:
    """Return the scene without what is seldom near."""
    contacts = tuple(name for name in options.contacts if name not in options.seldom)
    return replace(options, contacts=contacts, seldom=(), self_collisions=())


def near_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace whether something that the light scene leaves out is near, or loaded.

    Returns:
        Function (*state, *given) -> (near, apart), of which one is 1 and the other 0.
    """
    given = Given(mechanism, options)
    scene, state, dt = given.scene, given.state, given.dt
    kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
    left_out = [i for i, name in enumerate(options.contacts) if name in options.seldom]
    contacts = touching(scene, kinematics, state, dt)
    touches = [contacts[i].touch for i in left_out]
    touches += [pair.touch for pair in meeting_pairs(scene, kinematics, state, dt)]
    reach = [touch.depth - STEPS * dt * ca.fmin(ca.dot(touch.normal, touch.velocity), 0) for touch in touches]
    loads = ca.vertcat(SX(0, 1), *[touch.load for touch in touches])
    near = ca.logic_or(ca.mmax(ca.vertcat(*reach)) > -MARGIN, ca.sum1(loads) > 0)
    found = {"near": near, "apart": ca.logic_not(near)}
    everything = ca.vertcat(*found.values())
    inputs = {name: x for name, x in given.inputs().items() if ca.depends_on(everything, x)}
    return traced("near", inputs, found)


def light_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...]) -> ca.Function:
    """Trace an iteration of the light scene for a robot of the full one: contacts that are left out have no load.

    Returns:
        Function (*as `iteration_function` of the full scene but for `iterate`, `light_iterate`, apart) -> (*the same,
        `light_iterate_next`, unconverged, *outputs), of which what is 0 where it is near is `unconverged`.
    """
    full, part = iteration_function(mechanism, options, outputs), light(options)
    little, apart = iteration_function(mechanism, part, outputs), SX.sym("apart")
    sizes = {name: full.numel_in(name) for name in full.name_in() if name != "iterate"}
    given = {name: SX.sym(name, size) for name, size in sizes.items()}
    kept = [i for i, name in enumerate(options.contacts) if name in part.contacts]
    taken = {name: x[_rows(kept, PER_CONTACT.get(name, 0))] if name in PER_CONTACT else x for name, x in given.items()}
    own = {"iterate": SX.sym("light_iterate", iterate_size(mechanism, part))}
    found = little.call([{**taken, **own}[name] for name in little.name_in()])
    told = dict(zip(little.name_out(), found, strict=True))
    result: dict[str, SX] = {}
    for name in full.name_out():
        value, part_of = told.get(name, SX(0, 1)), name.removesuffix("_next")
        if part_of in PER_CONTACT or name not in told:
            whole = SX(ca.DM.zeros(full.numel_out(name)))
            whole[_rows(kept, PER_CONTACT.get(part_of, 0))] = value
            value = whole
        result[name] = value
    result.pop("iterate_next")
    result["unconverged"] = ca.logic_and(result["unconverged"], apart)
    if own["iterate"].numel():
        given["light_iterate"], result["light_iterate_next"] = own["iterate"], told["iterate_next"]
    return traced("light", given | {"apart": apart}, result)


def full_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...]) -> ca.Function:
    """Trace an iteration of the full scene where something is near, and nothing elsewhere.

    Returns:
        Function (*as `iteration_function`, near, *what it leaves, as it was) -> (*what it leaves).
    """
    full, near = iteration_function(mechanism, options, outputs), SX.sym("near")
    given = {name: SX.sym(name, full.numel_in(name)) for name in full.name_in()}
    found = dict(zip(full.name_out(), full.call(list(given.values())), strict=True))
    old: Mapping[str, SX] = {
        name: SX.sym(f"old_{name}", x.numel())
        for name, x in found.items()
        if name not in ("unconverged", "iterate_next")
    }
    result = {name: ca.if_else(near, x, old[name]) if name in old else x for name, x in found.items()}
    result["unconverged"] = ca.logic_and(result["unconverged"], near)
    return traced("full", given | {"near": near} | {f"old_{name}": x for name, x in old.items()}, result)


def _rows(places: list[int], size: int) -> list[int]:
    return [size * i + j for i in places for j in range(size)]
