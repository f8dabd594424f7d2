"""Only what is near: contacts that are declared to be seldom, and pairs of links, act where they may touch in a step.

A robot for which nothing of these is near makes the step without them. Whether it is follows from its own state alone,
and tiles in which no robot has anything near compute what is left of the same function, to the same bits, so that no
result depends on neighbours. Near is what is within a margin of the other, or would be within two steps at the speed at
which it approaches; what gets a speed from elsewhere in the step that takes it further begins to act in the step after
it.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import State, StepOptions
from ce_gym.dynamics.recursion.kinematics import outward_velocity_pass
from ce_gym.dynamics.stepping.step import meeting_pairs, touching
from ce_gym.dynamics.stepping.trace import Given
from ce_gym.model.mechanism import Mechanism

MARGIN = 0.01
"""What is nearer than this is near [m]."""
STEPS = 2.0
"""What comes as near as that within so many steps at the speed that it has is near, too."""
NEAR = "near"
"""Name of the buffer that says whether something is."""


def chooses(options: StepOptions) -> bool:
    """Whether something of a scene acts only where it is near."""
    return bool(options.seldom or options.self_collisions)


def near_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace whether something that acts only where it is near is near, or loaded.

    Returns:
        Function (*state, *given) -> near, which is 1 or 0.
    """
    given = Given(mechanism, options)
    scene, state, dt = given.scene, given.state, given.dt
    if not options.seldom:  # links are to each other what they would be on a base that rests at the origin
        state = _on_base_at_rest(mechanism, state)
    kinematics = outward_velocity_pass(scene.mechanism, state.q, state.v, state.dependent)
    contacts = touching(scene, kinematics, state, dt)
    named = zip(options.contacts, contacts, strict=True)
    touches = [contact.touch for name, contact in named if name in options.seldom]
    touches += [pair.touch for pair in meeting_pairs(scene, kinematics, state, dt)]
    reach = [touch.depth - STEPS * dt * ca.fmin(ca.dot(touch.normal, touch.velocity), 0) for touch in touches]
    loads = ca.vertcat(*[touch.load for touch in touches])
    near = ca.logic_or(ca.mmax(ca.vertcat(*reach)) > -MARGIN, ca.sum1(loads) > 0)
    inputs = {name: x for name, x in given.inputs().items() if ca.depends_on(near, x)}
    return traced(NEAR, inputs, {NEAR: near})


def _on_base_at_rest(mechanism: Mechanism, state: State) -> State:
    """Return a state whose base does not move and is where coordinates are those of the world."""
    layout = mechanism.robot.layout
    at_rest = SX(ca.DM(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])[: layout.base_nq]))
    q = ca.vertcat(at_rest, state.q[layout.base_nq :])
    return replace(state, q=q, v=ca.vertcat(SX(layout.base_nv, 1), state.v[layout.base_nv :]))
