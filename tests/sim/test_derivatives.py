"""Gradients through steps against central differences of the steps themselves."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, StepDerivatives, Terrain
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot, load_robot
from ce_gym.sim.tiles import read_rows, write_rows

STEP = 2e-7


def moved(q: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Positions of a floating base moved along their tangent, to second order; in numbers, quaternion by quaternion."""
    w, u = q[:, 3], q[:, 4:7]
    d = tangent[:, :3] / 2
    p = tangent[:, 3:6]
    turned = p + 2 * np.cross(u, np.cross(u, p) + w[:, None] * p)
    quat = np.hstack([(w - (u * d).sum(1))[:, None], u + w[:, None] * d + np.cross(u, d)])
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return np.hstack([q[:, :3] + turned, quat, q[:, 7:] + tangent[:, 6:]])


def apart(q: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The tangent from one position to a close one, floating base."""
    w, u = q[:, 3], q[:, 4:7]
    ow, ou = other[:, 3], other[:, 4:7]
    turn = 2 * (w[:, None] * ou - ow[:, None] * u - np.cross(u, ou))
    p = other[:, :3] - q[:, :3]
    back = p + 2 * np.cross(-u, np.cross(-u, p) + w[:, None] * p)
    return np.hstack([turn, back, other[:, 7:] - q[:, 7:]])


class Differences:
    """Central differences of steps with the whole state of a robot."""

    def __init__(self, sim: Simulator, target: np.ndarray, n_substeps: int = 1) -> None:
        self.sim, self.target, self.n = sim, target, n_substeps
        self.start = {name: array.copy() for name, array in sim._arrays.items()}
        self.center = self.after("", 0, 0.0)

    def after(self, part: str, column: int, amount: float) -> tuple[np.ndarray, np.ndarray]:
        sim, target = self.sim, np.array(np.broadcast_to(self.target, (self.sim.num_envs, self.target.shape[-1])))
        for name, array in self.start.items():
            sim._arrays[name][...] = array
        if part == "target":
            target[:, column] += amount
        elif part == "q" and sim.model.robot.floating:
            tangent = np.zeros((sim.num_envs, sim.model.nv))
            tangent[:, column] = amount
            write_rows(sim._arrays["q"], moved(sim.q, tangent))
        elif part:
            rows = read_rows(sim._arrays[part], sim.num_envs)
            rows[:, column] += amount
            write_rows(sim._arrays[part], rows)
        sim.step(target, self.n)
        return sim.q, sim.v

    def column(self, part: str, column: int) -> np.ndarray:
        (q1, v1), (q2, v2) = self.after(part, column, -STEP), self.after(part, column, STEP)
        dq = apart(q1, q2) if self.sim.model.robot.floating else q2 - q1
        return np.hstack([dq, v2 - v1]) / (2 * STEP)

    def restore(self) -> None:
        for name, array in self.start.items():
            self.sim._arrays[name][...] = array


def dropped(n: int = 24) -> tuple[Simulator, np.ndarray]:
    """Robots that stand, slide, and fly, some time after a drop, and targets that not all motors can follow."""
    model = Model(TRIPOD)
    sim = Simulator(model, n, contacts="foot", outputs=("contact_forces",))
    rng = np.random.default_rng(5)
    q = np.tile(model.standing_q, (n, 1)) + rng.normal(0, 0.05, (n, model.nq)) * (np.arange(model.nq) > 6)
    q[:, 2] += np.linspace(-0.01, 0.05, n)
    v = rng.normal(0, 0.5, (n, model.nv))
    sim.set_state(q, v)
    target = model.standing_q[7:] + rng.normal(0, 0.3, (n, 2))
    sim.step(target, 4)
    return sim, target


def standing(n: int = 9) -> tuple[Simulator, np.ndarray]:
    """Robots that all stand and sway, a little different from each other."""
    model, rng = Model(TRIPOD), np.random.default_rng(7)
    sim = Simulator(model, n, contacts="foot", outputs=("contact_forces",))
    target = model.standing_q[7:] + rng.normal(0, 0.05, (n, 2))
    sim.step(target, 100)
    sim.set_state(sim.q, sim.v + rng.normal(0, 0.02, (n, model.nv)))  # as if it had just been pushed
    sim.step(target, 10)
    return sim, target


def errors(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Largest error of each robot, relative to its largest entry."""
    rows = tuple(range(1, ours.ndim))
    return np.abs(ours - theirs).max(rows) / np.abs(theirs).max(rows)


def test_linearize_a_fixed_leg():
    model = Model("planar_leg_linkage")
    sim, rng = Simulator(model, 5), np.random.default_rng(0)
    sim.set_state(model.standing_q + rng.normal(0, 0.1, (5, 2)), rng.normal(0, 1, (5, 2)))
    A, B = StepDerivatives(sim).linearize(model.standing_q)
    assert errors(np.concatenate([A, B], axis=2), columns(sim, model.standing_q)).max() < 1e-8


def columns(sim: Simulator, target: np.ndarray) -> np.ndarray:
    """[A, B] by differences."""
    differences, nv = Differences(sim, target), sim.model.nv
    sizes = {"q": nv, "v": nv, "target": target.shape[-1]}
    return np.stack([differences.column(part, i) for part, n in sizes.items() for i in range(n)], axis=2)


def test_linearize_through_contact_and_all_iterations():
    sim, target = dropped()
    A, B = StepDerivatives(sim).linearize(target)
    assert errors(np.concatenate([A, B], axis=2), columns(sim, target)).max() < 1e-6


def test_linearize_robots_that_stand():
    sim, target = standing()
    weight = 9.81 * sim.model.total_mass
    assert (sim.contact_forces[:, :, 2].sum(1) > 0.5 * weight).all()
    assert (sim.contact_forces[:, :, 2] > 0.02 * weight).sum(1).min() >= 3
    A, B = StepDerivatives(sim).linearize(target)
    assert errors(np.concatenate([A, B], axis=2), columns(sim, target)).max() < 1e-6


@pytest.mark.parametrize(
    ("robot", "options"),
    [
        ("planar_leg_linkage", {"control": "motor_position", "motors": "limited"}),
        ("planar_leg_linkage", {"control": "torque", "dtype": "float32"}),
        ("four_bar", {}),
    ],
)
def test_linearize_gives_the_rows_of_the_reverse_mode(robot: str, options: dict):
    model, rng = Model(robot), np.random.default_rng(2)
    sim = Simulator(model, 11, **options)
    sim.set_state(model.standing_q + rng.normal(0, 0.1, (11, model.nq)), rng.normal(0, 3, (11, model.nv)))
    target = rng.normal(0, 1, (11, len(sim.target_names)))
    derivatives = StepDerivatives(sim)
    ours, theirs = (np.dstack(both) for both in (derivatives.linearize(target), derivatives._linearize_by_rows(target)))
    assert errors(ours, theirs).max() < (1e-4 if sim.dtype == "float32" else 1e-11)


def test_backward_through_steps_in_contact():
    sim, target = dropped()
    derivatives, rng, nv = StepDerivatives(sim), np.random.default_rng(1), sim.model.nv
    weights = {name: rng.normal(size=(sim.num_envs, nv)) for name in ("q", "v")}
    sizes = {"q": nv, "v": nv, "load": 3, "target": 2}
    theirs, center = weighted_differences(sim, target, weights, sizes, 5)
    derivatives.step(target, 5)
    assert derivatives.n_recorded == 5
    np.testing.assert_allclose(sim.q, center[0], rtol=0, atol=1e-12)  # in five calls instead of one
    start = derivatives._records[0].arrays["load"]
    state, targets, _ = derivatives.backward(weights)
    ours = state | {"target": sum(targets)}
    for part in ("q", "v", "target"):  # one robot's slip turns so fast that differences err by the square of STEP
        assert np.sort(errors(ours[part], theirs[part]))[-2] < 1e-5, part
        assert errors(ours[part], theirs[part]).max() < 5e-5, part
    carried = read_rows(start, sim.num_envs) > 1.0  # a load of zero is where its effect has a kink
    assert carried.sum() > 4
    expected = theirs["load"]
    assert np.abs(ours["load"] - expected)[carried].max() < 1e-5 * np.abs(expected[carried]).max()


def weighted_differences(
    sim: Simulator, target: np.ndarray, weights: dict[str, np.ndarray], sizes: dict[str, int], n_substeps: int = 1
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """The gradient of a weighted sum of the state after some sub-steps by differences, and that state."""
    differences, both = Differences(sim, target, n_substeps), np.hstack([weights["q"], weights["v"]])
    found = {
        part: np.stack([(differences.column(part, i) * both).sum(1) for i in range(n)], axis=1)
        for part, n in sizes.items()
    }
    differences.restore()
    return found, differences.center


def test_linearizations_of_the_whole_state_chain_through_contact():
    """Robots land, slide and come to rest; what contacts remember passes from step to step."""
    sim, target = dropped()
    derivatives, nv = StepDerivatives(sim), sim.model.nv
    differences = Differences(sim, target, 20)
    theirs = np.stack([differences.column(part, i) for part in ("q", "v") for i in range(nv)], axis=2)
    differences.restore()
    chain, without = chained(derivatives, target, 20)
    assert errors(chain[:, : 2 * nv, : 2 * nv], theirs).max() < 1e-5
    assert errors(without, theirs).max() > 0.1  # loads held constant


def chained(derivatives: StepDerivatives, target: np.ndarray, n_substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Products of `A` of the whole state, compared with reverse mode, and of its part [q; v] over some sub-steps."""
    sim, nv = derivatives.simulator, derivatives.simulator.model.nv
    whole, part = np.eye(sum(derivatives.state_sizes.values())), np.eye(2 * nv)
    for _ in range(n_substeps):
        A, B = derivatives.linearize(target, whole_state=True)
        assert errors(np.dstack([A, B]), np.dstack(derivatives._linearize_by_rows(target, True))).max() < 1e-11
        whole, part = A @ whole, A[:, : 2 * nv, : 2 * nv] @ part
        sim.step(target)
    return whole, part


def test_linearizations_with_bristles_chain():
    """A block that slides on one of its corners."""
    sim, nothing = sliding_block(contacts=("c0",)), np.zeros(0)
    derivatives = StepDerivatives(sim)
    assert derivatives.state_sizes == {"q": 6, "v": 6, "load": 1, "anchor": 2}
    touching = read_rows(sim._arrays["load"], 9)[:, 0] > 1.0
    assert touching.sum() >= 3
    weights, rng = {}, np.random.default_rng(3)
    for name, size in derivatives.state_sizes.items():
        weights[name] = rng.normal(size=(9, size))
    start = derivatives.state()
    chain, _ = chained(derivatives, nothing, 10)
    derivatives.restore(start)
    derivatives.step(nothing, 10)
    found, _, _ = derivatives.backward(weights)
    theirs = np.einsum("nij,ni->nj", chain, np.hstack(list(weights.values())))
    assert errors(np.hstack(list(found.values())), theirs).max() < 1e-9


def test_dry_friction_of_joints_that_stick_and_slip():
    """Forwards and backwards, in a leg whose links are loops: friction of dependent joints varies with the pose."""
    robot = load_robot("planar_leg_linkage")
    bodies = [replace(b, joint=replace(b.joint, friction=0.2 + 0.1 * i)) for i, b in enumerate(robot.bodies)]
    model, rng = Model(replace(robot, bodies=tuple(bodies))), np.random.default_rng(3)
    sim = Simulator(model, 11, control="torque", outputs=())
    q, target = model.standing_q + rng.normal(0, 0.1, (11, 2)), rng.normal(0, 2, (11, 2))
    v = rng.choice([-1.0, 1.0], (11, 2)) * rng.uniform(0.5, 3, (11, 2))
    v[:5] = 0.0  # these stick, or have just been released
    sim.set_state(q, v)
    differences, derivatives = Differences(sim, target), StepDerivatives(sim)
    moved = np.abs(differences.center[0] - q).max(1)
    assert 0 < (moved == 0).sum() < 11
    differences.restore()
    A, B = derivatives.linearize(target)
    theirs = [differences.column(part, i) for part in ("q", "v", "target") for i in range(2)]
    differences.restore()
    ours = np.concatenate([A, B], axis=2)
    assert errors(ours, np.stack(theirs, axis=2)).max() < 1e-5
    assert errors(ours, np.dstack(derivatives._linearize_by_rows(target))).max() < 1e-9


def test_resets_and_diverged_robots_pass_nothing_on():
    model = Model("planar_leg_linkage")
    sim = Simulator(model, 3)
    derivatives = StepDerivatives(sim)
    derivatives.step(model.standing_q)
    sim.set_state(model.standing_q + 0.1, np.zeros(2), np.array([True, False, False]))
    sim._arrays["diverged"][0, 0, 1] = 1.0
    derivatives.step(model.standing_q)
    state, targets, _ = derivatives.backward({"q": np.ones((3, 2))})
    assert not state["q"][:2].any()
    assert state["q"][2].all()
    assert not targets[0][:2].any()
    assert targets[1][0].all()
    assert not targets[1][1].any()


CHANGES = {
    "its own state": lambda sim, derivatives: sim.set_state(sim.q, sim.v),
    "its own snapshot": lambda sim, derivatives: sim.restore(sim.snapshot()),
    "its own parts": lambda sim, derivatives: derivatives.restore(derivatives.state()),
    "a step without a record": lambda sim, derivatives: sim.step(np.zeros(2)),
    "a reset": lambda sim, derivatives: sim.reset(),
}


@pytest.mark.parametrize("keep_every", [1, 100])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_gradients_stop_at_each_change_of_the_state(change, keep_every: int):
    """Also at one that leaves positions and velocities, where contacts keep or lose their memory."""
    (sim, target), weights = standing(3), {"v": np.ones((3, 8))}
    derivatives, later = StepDerivatives(sim, keep_every), StepDerivatives(sim)
    derivatives.step(target, 3)
    change(sim, derivatives)
    for recorder in (derivatives, later):
        state = sim.snapshot()
        recorder.step(target, 2)
        if recorder is derivatives:
            sim.restore(state)
    (before, targets, _), (_, expected, _) = derivatives.backward(weights), later.backward(weights)
    np.testing.assert_array_equal(targets[3:], expected)
    assert not any(rows.any() for rows in (*targets[:3], *before.values()))


def test_gradients_pass_a_change_of_other_parts():
    """Robots whose velocities were set keep the gradient to their positions; another parameter cuts nothing."""
    model = Model("planar_leg_linkage")
    sim = Simulator(model, 2, parameters=("kp",))
    derivatives = StepDerivatives(sim)
    derivatives.step(model.standing_q)
    derivatives.restore({"v": sim.v})
    A, _ = derivatives.linearize(model.standing_q)
    derivatives.step(model.standing_q)
    set_v, *_ = derivatives.backward({"q": np.ones((2, 2))})
    sim.reset()
    B, _ = derivatives.linearize(model.standing_q)
    np.testing.assert_allclose(set_v["q"][0], (A[0, :2, :2].sum(0)) @ B[0, :2, :2], rtol=1e-9)
    derivatives.step(model.standing_q)
    sim.set_parameter("kp", 2 * sim.snapshot()["parameters"])
    derivatives.step(model.standing_q)
    assert derivatives.backward({"q": np.ones((2, 2))})[0]["q"].all()


def test_gradient_to_parameters():
    model = Model("planar_leg_linkage")
    sim = Simulator(model, 2, parameters=("kp", "kd"))
    target = model.standing_q + 0.02
    derivatives = StepDerivatives(sim)
    derivatives.step(target, 3)
    _, _, ours = derivatives.backward({"v": np.ones((2, 2))})
    default = read_rows(sim._arrays["parameters"], 2)[0]

    def after(values: np.ndarray) -> float:
        sim.set_parameter("kp", values[:2])
        sim.set_parameter("kd", values[2:])
        sim.reset()
        sim.step(target, 3)
        return float(sim.v[0].sum())

    for i, size in enumerate(1e-4 * default):
        change = np.eye(4)[i] * size
        expected = (after(default + change) - after(default - change)) / (2 * size)
        assert abs(ours[0, i] - expected) < 1e-6 * abs(expected)


def test_gradients_go_through_parts_of_a_step():
    """Robots too fast for their step make it in parts of different lengths; their neighbour makes a whole one."""
    model, rng = Model("planar_leg_linkage"), np.random.default_rng(4)
    sim, target = Simulator(model, 4, 0.01, parameters=("kp",)), np.tile(model.standing_q, (4, 1))
    v = np.zeros((4, model.nv))
    v[1:] = [[120.0, 120.0], [60.0, 60.0], [-80.0, 80.0]]
    sim.set_state(model.standing_q, v)
    weights = {name: rng.normal(size=(4, model.nv)) for name in ("q", "v")}
    theirs, _ = weighted_differences(sim, target, weights, dict.fromkeys(("q", "v", "target", "parameters"), 2), 2)
    derivatives = StepDerivatives(sim)
    derivatives.step(target, 2)
    assert sim.n_retried >= 3
    assert not sim.diverged.any()
    parts = derivatives._records[0].in_parts[0]
    assert parts is not None
    assert parts.tolist() == [False, True, True, True]
    found, targets, gains = derivatives.backward(weights)
    for name, ours in (found | {"target": sum(targets), "parameters": gains}).items():
        np.testing.assert_allclose(ours, theirs[name], rtol=0, atol=1e-6 * np.abs(theirs[name]).max())


def sliding_block(**options) -> Simulator:
    """Blocks with round corners on a slope and above it."""
    places = [(x, y, -0.03) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    corners = tuple(ContactSphere(f"c{i}", "body", place, 0.02) for i, place in enumerate(places))
    body = Body("body", "link", None, Placement(), Joint("free"), Inertial(5.0, (0.0, 0.0, 0.0), np.diag([0.4] * 3)))
    material = ContactMaterial(5e4, 500.0, friction=0.5, slip_speed=1e-3, bristle=5e4)
    model, rng = Model(Robot("block", (body,), contacts=corners, material=material)), np.random.default_rng(0)
    sim = Simulator(model, 9, terrain=Terrain.slope(0.15, 0.4), outputs=(), **options)
    q = sim.q
    q[:, 2] += np.linspace(0, 0.05, 9)
    sim.set_state(q, rng.normal(0, 0.2, (9, 6)))
    sim.step(np.zeros(0), 40)
    sim.set_state(sim.q, sim.v + rng.normal(0, 0.02, (9, 6)))
    sim.step(np.zeros(0), 5)
    return sim


def test_linearize_on_a_slope():
    sim = sliding_block()
    assert (read_rows(sim._arrays["load"], 9).sum(1) > 5.0).sum() >= 5
    A, _ = StepDerivatives(sim).linearize(np.zeros(0))
    differences = Differences(sim, np.zeros(0))
    theirs = [differences.column(part, i) for part in ("q", "v") for i in range(6)]
    assert errors(A, np.stack(theirs, axis=2)).max() < 1e-6


def test_dropped_records_are_recomputed():
    every, some = (StepDerivatives(sliding_block(), keep_every=k) for k in (1, 4))
    for derivatives in (every, some):
        derivatives.step(np.zeros(0), 6)
        pushed = np.arange(9) == 2
        derivatives.simulator.set_state(derivatives.simulator.q, np.ones(6), pushed)
        derivatives.step(np.zeros(0), 3)
    assert every.n_recorded == some.n_recorded == 9
    assert some.bytes_recorded < every.bytes_recorded / 2
    weights = {"q": np.random.default_rng(0).normal(size=(9, 6))}
    (ours, _, _), (theirs, _, _) = some.backward(weights), every.backward(weights)
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert not ours["q"][2].any()
    assert ours["q"][0].any()


def test_bad_arguments_are_named():
    model = Model("planar_leg_linkage")
    with pytest.raises(ValueError, match="keep_every=0; expected a whole number, at least 1"):
        StepDerivatives(Simulator(model), keep_every=0)
    derivatives = StepDerivatives(Simulator(model))
    with pytest.raises(ValueError, match="weights of 'height'; expected some of q, v"):
        derivatives.backward({"height": np.zeros(1)})
    with pytest.raises(ValueError, match=r"weights\['q'\] has shape \(2,\); expected \(1, 2\)"):
        derivatives.backward({"q": np.zeros(2)})


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda derivatives: pickle.loads(pickle.dumps(derivatives))],
    ids=["copy", "deepcopy", "pickle"],
)
@pytest.mark.parametrize("keep_every", [1, 4])
def test_a_copy_of_a_recorder_goes_on_by_itself(copied, keep_every: int):
    sim, target = dropped(5)
    recorders = [StepDerivatives(sim, keep_every=keep_every)]
    recorders[0].step(target, 3)
    recorders.append(copied(recorders[0]))
    for recorder in recorders:
        recorder.step(target, 2)
        assert recorder.n_recorded == 5
    v = recorders[0].simulator.v
    np.testing.assert_array_equal(recorders[1].simulator.v, v)
    (first, targets, _), (copied_first, copied_targets, _) = (each.backward({"v": v}) for each in recorders)
    for name, gradient in first.items():
        np.testing.assert_array_equal(copied_first[name], gradient, err_msg=name)
    np.testing.assert_array_equal(copied_targets, targets)
    assert np.abs(targets[0]).max() > 0
