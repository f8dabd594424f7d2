"""Laws of mechanics on random mechanisms, drawn by hypothesis (mechanisms.py).

Every robot is checked at states near its reference pose: eliminated rotors against rotors as bodies, both against dense
numpy, forward against inverse dynamics, mass matrix and power.
"""

from __future__ import annotations

import numpy as np
from dense import Dense
from hypothesis import HealthCheck, assume, given, settings
from mechanisms import Recipe, build, recipes

from ce_gym.dynamics import Model
from ce_gym.model import check_robot, cluster_tree

TOLERANCE = 1e-9
STATES = 3
REPEATABLE = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def close(ours: np.ndarray, theirs: np.ndarray, scale: float = 1.0) -> bool:
    return bool(np.abs(ours - theirs).max(initial=0.0) <= TOLERANCE * max(scale, np.abs(theirs).max(initial=0.0)))


def within_reach(model: Model, q: np.ndarray) -> bool:
    """Whether loops close at these positions, away from singularities: a short rod may not reach."""
    try:
        return bool((model.nearness(q) > 0.3).all())
    except ValueError as error:
        if "singularity" in str(error) or "do not close" in str(error):
            return False
        raise


def check_dynamics(recipe: Recipe) -> None:
    robot = build(recipe)
    check_robot(robot)
    assume(all(c.independent or c.bodies == ("base",) for c in cluster_tree(robot).clusters))  # no part is locked
    model, general = Model(robot), Model(robot, eliminate_rotors=False)
    assert not any(general.mechanism.eliminated_rotors)
    rng = np.random.default_rng(recipe.seed)
    spread = 0.02 if recipe.rod or recipe.four_bar else 1.5
    q = model.standing_q + rng.uniform(-spread, spread, (STATES, model.nq))
    if robot.floating:
        q[:, 3:7] = rng.normal(size=(STATES, 4))
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    assume(within_reach(model, q))
    v, tau, vdot = (rng.normal(0, size, (STATES, model.nv)) for size in (1.0, 3.0, 5.0))

    accelerations = model.forward_dynamics(q, v, tau)
    forces = model.inverse_dynamics(q, v, vdot)
    assert close(accelerations, general.forward_dynamics(q, v, tau))
    assert close(model.inverse_dynamics(q, v, accelerations), tau)
    assert close(model.forward_dynamics(q, v, forces), vdot)

    M, bias = model.mass_matrix(q), model.inverse_dynamics(q, v, 0.0 * v)
    assert close(M, np.swapaxes(M, -1, -2))
    assert np.linalg.eigvalsh(M).min() > 0.0
    assert close(np.einsum("nij,nj->ni", M, accelerations) + bias, tau)

    spanning = model.spanning(q, v)
    spanning_accelerations = model.spanning_acceleration(q, v, accelerations)
    (G, g), (K, k) = model.explicit_constraint(q, v), model.implicit_constraint(q, v)
    for i, (q_span, v_span) in enumerate(zip(*spanning, strict=True)):
        dense = Dense(robot, q_span, v_span)
        phi, rows, right = dense.constraints()
        assert close(phi, 0 * phi)
        assert close(rows @ G[i], 0 * rows @ G[i], np.abs(G[i]).max())
        assert close(K[i] @ G[i], 0 * K[i] @ G[i], np.abs(K[i]).max(initial=1.0) * np.abs(G[i]).max())
        assert close(rows @ g[i], right)
        assert close(K[i] @ g[i], k[i])
        drive = np.zeros(dense.n)
        free = [*range(6 if robot.floating else 0), *(dense.columns[name] for name in model.joint_links)]
        drive[free] = tau[i]
        assert close(spanning_accelerations[i], dense.acceleration(drive))
        power, terms = tau[i] @ v[i], np.abs(tau[i]) @ np.abs(v[i])
        assert abs(dense.energy_rate(spanning_accelerations[i]) - power) <= TOLERANCE * max(1.0, terms)


@settings(REPEATABLE, max_examples=25)
@given(recipes(loops=False))
def test_trees_with_transmissions(recipe: Recipe):
    check_dynamics(recipe)


@settings(REPEATABLE, max_examples=20)
@given(recipes(loops=True))
def test_closed_loops(recipe: Recipe):
    check_dynamics(recipe)
