"""Transmissions that stretch: against free rotors, closed forms, the rigid limit, and the laws of energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from elastic_robots import KINDS, LINK, RATIO, ROTOR, differential, elastic, turntable, untied

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.plan import MOVED
from ce_gym.dynamics.laws.drive_meshes import mesh_energy
from ce_gym.dynamics.laws.scene_parameters import make_scene
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Robot, load_robot
from ce_gym.model.mechanism import LEVELS

State = tuple[np.ndarray, np.ndarray]
SX = ca.SX


def stepper(model: Model, dt: float, outputs: tuple[str, ...] = (), **options) -> Callable[..., dict[str, np.ndarray]]:
    """Return a step from positions, velocities and targets to the named results."""
    function = step_function(model.mechanism, StepOptions(dt, **{"control": "torque", **options}), outputs)

    def step(q, v, target, **parameters) -> dict[str, np.ndarray]:
        results = function(q=q, v=v, diverged=0.0, target=target, **parameters)
        assert not float(results["diverged_next"])
        return {name: value.full().ravel() for name, value in results.items()}

    return step


def after(model: Model, dt: float, time: float, target, start: State | None = None, **options) -> State:
    """Return positions and velocities of a robot that starts at rest."""
    step, (q, v) = stepper(model, dt, **options), start or (model.standing_q, np.zeros(model.nv))
    for _ in range(round(time / dt)):
        result = step(q, v, target)
        q, v = result["q_next"], result["v_next"]
    return q, v


@pytest.mark.parametrize("kind", KINDS)
def test_rotors_move_as_free_bodies_that_a_spring_drives(kind: str):
    """The elastic level has the bodies of a robot whose rotors are tied to nothing, in other coordinates."""
    robot, rng = KINDS[kind](), np.random.default_rng(0)
    model, free, rotors = Model(elastic(robot, 1.0), "elastic"), Model(untied(robot)), [r.name for r in robot.rotors()]
    n = len(robot.independent)
    q = np.concatenate([Model(robot).standing_q, np.zeros(len(rotors))]) + 0.1 * rng.normal(size=model.nq)
    v, tau = rng.normal(size=(2, model.nv))
    W = model.actuator_matrix(q, rotors)
    np.testing.assert_array_equal(W[:, n:], np.eye(len(rotors)))
    rows = [model.spanning_names.index(name) for name in rotors]
    theta, thetad = (x[rows] for x in model.spanning(q, v))
    on_free = np.concatenate([tau[:n] - W[:, :n].T @ tau[n:], tau[n:]])
    expected = free.forward_dynamics(np.concatenate([q[:n], theta]), np.concatenate([v[:n], thetad]), on_free)
    found = model.forward_dynamics(q, v, tau)
    rotor = model.evaluate("spanning_acceleration", q, v, found)[0][rows, 0]
    np.testing.assert_allclose(np.concatenate([found[:n], rotor]), expected, rtol=1e-11, atol=1e-11)
    assert model.total_mass == pytest.approx(robot.total_mass)


def two_masses(k: float, d: float, torque: float, time: float) -> np.ndarray:
    """Angles of table and stretch of the turntable at a time, from its linear equations, in closed form."""
    M = np.array([[LINK + RATIO**2 * ROTOR, RATIO * ROTOR], [RATIO * ROTOR, ROTOR]])
    A, b = np.zeros((5, 5)), np.linalg.solve(M, [torque, torque / RATIO])
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2], A[2:4, 2:4] = (np.linalg.solve(M, np.diag([0.0, -x])) for x in (k, d))
    A[2:4, 4] = b
    small, term, total = A * time / 1024, np.eye(5), np.eye(5)
    for i in range(1, 12):
        term = term @ small / i
        total = total + term
    return (np.linalg.matrix_power(total, 1024) @ [0.1, 0.02, 0.0, 0.0, 1.0])[:2]


@pytest.mark.parametrize(("method", "order", "dt"), [("euler", 1, 1e-5), ("extrapolated", 2, 1e-4), ("rk4", 4, 1e-4)])
def test_order_of_the_step_at_a_fixed_stiffness(method: str, order: int, dt: float):
    k, d, time = 2.0, 1e-3, 0.01
    model, exact = Model(turntable(k, damping=d), "elastic"), two_masses(k, d, 0.3, time)
    errors = []
    for step in (dt, dt / 2):
        q, _ = after(model, step, time, [0.3], (np.array([0.1, 0.02]), np.zeros(2)), method=method)
        errors.append(np.abs(q - exact).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("control", ["torque", "position"])
@pytest.mark.parametrize("kind", KINDS)
def test_as_stiffness_grows_robots_move_as_exact_ones(kind: str, control: str):
    """The error falls as 1 / k over nine decades, at a step that resolves no spring."""
    robot, dt, time = KINDS[kind](), 0.002, 0.03
    if control == "position" and not robot.gains.kp:
        pytest.skip("no gains")
    exact, n = Model(robot), len(robot.independent)
    target = exact.standing_q + 0.05 if control == "position" else np.full(n, 2.0)
    expected, _ = after(exact, dt, time, target, control=control)
    errors = [
        np.abs(after(Model(elastic(robot, k), "elastic"), dt, time, target, control=control)[0][:n] - expected).max()
        for k in (1e3, 1e5, 1e7, 1e10)
    ]
    np.testing.assert_allclose(np.diff(np.log10(errors)) / [2, 2, 3], -1, atol=0.1)


MESHES = {
    "spring": {},
    "backlash": {"backlash": 0.02},
    "damped": {"backlash": 0.02, "damping": 0.01},
    "belt": {"preload": 5.0, "damping": 0.01},
}


@pytest.mark.parametrize("dt", [1e-4, 0.005, 0.02])
@pytest.mark.parametrize("mesh", MESHES)
def test_a_stiff_light_drive_is_stable_and_takes_energy_from_nowhere(mesh: str, dt: float):
    """10^5 N m/rad and a rotor of 10^-5 kg m^2, thrown from flank to flank; and a differential of two such drives."""
    both = Model(elastic(differential(), 1e5, **MESHES[mesh]), "elastic")
    one = Model(turntable(1e5, **MESHES[mesh]), "elastic")
    starts = [(one, [0.3, 0.004], [-3.0, 200.0]), (both, [0.3, -0.2, 0.004, 0.02], [-3.0, 2.0, 200.0, -90.0])]
    for model, q, v in starts:
        step, energies = stepper(model, dt, ("energy",)), []
        for _ in range(200):
            result = step(q, v, np.zeros(len(model.joint_links)))
            q, v = result["q_next"], result["v_next"]
            energies.append(float(result["energy"][0]))
        assert np.diff(energies).max() < 1e-13 * energies[0]
        gap = MESHES[mesh].get("backlash", 0.0) / 2
        assert np.abs(q[len(model.joint_links) :]).max() < gap + 1e-3


def thrown(stiffness: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies (steps, robots) of Mini Cheetahs that fly, their rotors from flank to flank, and whether any failed."""
    robot = replace(load_robot("mini_cheetah"), gravity=(0.0, 0.0, 0.0))
    model, n, rng = Model(elastic(robot, stiffness, backlash=0.03), "elastic"), 8, np.random.default_rng(0)
    step = step_function(model.mechanism, StepOptions(dt, control="torque"), ("energy",)).map(n)
    q, v = np.tile(model.standing_q[:, None], (1, n)), rng.normal(0, 1, (model.nv, n))
    v[18:] *= 20
    q[19:] = rng.uniform(-0.015, 0.015, (12, n))
    energies, diverged = [], np.zeros((1, n))
    for _ in range(100):
        found = step(q=q, v=v, diverged=diverged, target=np.zeros((12, n)))
        q, v, diverged, energy = (found[k].full() for k in ("q_next", "v_next", "diverged_next", "energy"))
        energies.append(energy[0])
    return np.array(energies), diverged


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [28.0, 3e4, 3e6])
def test_twelve_drives_take_energy_from_nowhere(stiffness: float):
    """Flanks of all drives are solved together; the energy may grow by 0.1 % at most."""
    energies, diverged = thrown(stiffness, 0.005)
    assert not diverged.any()
    assert (energies.max(axis=0) <= 1.001 * energies[0]).all()


def test_stretches_do_not_make_a_step_in_parts():
    """A rotor that flies to its other flank moves no body: further than a step may turn a joint is not too far."""
    model = Model(turntable(40.0, backlash=1.0), "elastic")
    step = step_function(model.mechanism, StepOptions(0.005), (MOVED,))
    moved = [float(step(q=[0.0, -0.4], v=v, diverged=0.0, target=[0.0])[MOVED]) for v in ([0.0, 150.0], [150.0, 0.0])]
    assert moved[0] < 1e-3
    assert moved[1] == pytest.approx(0.75)


@lru_cache
def hunting(dt: float) -> tuple[float, float]:
    """Amplitude [rad] and period [s] of a joint that hunts across its backlash under integral control of the link."""
    model = Model(turntable(1e5, damping=1.0, backlash=0.02), "elastic")
    step = step_function(model.mechanism, StepOptions(dt, control="torque"))
    q, v, integral = SX.sym("q", 2), SX.sym("v", 2), SX.sym("integral")
    result = step(q=q, v=v, diverged=0.0, target=-20.0 * q[0] - 0.3 * v[0] - 150.0 * integral)
    state = ca.vertcat(q, v, integral)
    later = ca.vertcat(result["q_next"], result["v_next"], integral + dt * result["q_next"][0])
    angles = ca.Function("one", [state], [later]).mapaccum(round(3.5 / dt))([0.01, 0.01, 0.0, 0.0, 0.0])[0, :].full()[0]
    y = angles[round(2.0 / dt) :]
    up = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    crossings = dt * (up - y[up] / (y[up + 1] - y[up]))
    return np.ptp(y) / 2, float(np.diff(crossings).mean())


@pytest.mark.parametrize(("dt", "within"), [(1e-4, 0.02), (1e-3, 0.1)])
def test_a_limit_cycle_of_backlash(dt: float, within: float):
    """As in steps of 10 us, in which the flanks' own oscillation is resolved."""
    np.testing.assert_allclose(hunting(dt), hunting(1e-5), rtol=within)
    assert hunting(1e-5)[0] > 0.01 / RATIO / 10, "it does hunt"


def test_backlash_is_between_flanks_and_a_belt_half_as_stiff_when_slack():
    """Torques of meshes, from what turns a rotor of the turntable in a step that is short."""
    dt, x = 1e-9, np.array([-0.3, -0.05, -0.02, 0.0, 0.03, 0.06, 0.3])

    def torque(**figures: float) -> np.ndarray:
        step = stepper(Model(turntable(40.0, **figures), "elastic"), dt)
        rotor = np.array([(step([0.0, s], np.zeros(2), [0.0])["v_next"] / dt) @ [RATIO, 1.0] for s in x])
        return -ROTOR * rotor

    np.testing.assert_allclose(torque(), 40.0 * x, rtol=1e-6)
    np.testing.assert_allclose(torque(backlash=0.1), 40.0 * (x - x.clip(-0.05, 0.05)), rtol=1e-6, atol=1e-9)
    tight = 40.0 * x.clip(-0.1, 0.1) + 20.0 * (x - x.clip(-0.1, 0.1))
    np.testing.assert_allclose(torque(preload=4.0), tight, rtol=1e-6)


def test_between_flanks_a_rotor_is_free_however_damped_they_are():
    """It flies towards a flank that it will not reach in this step, and is stopped by one that it will."""
    step = stepper(Model(turntable(40.0, backlash=0.02, damping=1.0), "elastic"), 1e-4)
    assert step([0.0, -0.005], [0.0, 50.0], [0.0])["v_next"] @ [0.0, 1.0] == pytest.approx(50.0, rel=1e-12)
    assert step([0.0, 0.009], [0.0, 50.0], [0.0])["q_next"][1] == pytest.approx(0.01, abs=5e-4)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("damping", [0.0, 0.05])
@pytest.mark.parametrize("name", ["one drive", "two drives"])
def test_expected_accelerations_of_stretches_are_those_without_their_meshes(name: str, damping: float, side: int):
    """A dense solve without the mesh, with the damping of motors and joints at the end of the step."""
    k, d, gap, dt = 40.0, 0.02, 0.01, 0.004
    N, inertia, robot = {
        "one drive": (np.array([[RATIO]]), ROTOR, turntable(k, damping=d, backlash=2 * gap)),
        "two drives": (
            np.array([[3.0, 4.0], [3.0, -4.0]]),
            2e-4,
            elastic(differential(), k, damping=d, backlash=2 * gap),
        ),
    }[name]
    n = len(N)
    motors = tuple(replace(motor, damping=damping / (i + 1)) for i, motor in enumerate(robot.motors))
    bodies = tuple(
        replace(body, joint=replace(body.joint, damping=0.03 * (body.kind == "link"))) for body in robot.bodies
    )
    model = Model(replace(robot, motors=motors, bodies=bodies), "elastic")
    x, yd, xd = side * np.array([0.012, 0.011])[:n], np.array([0.4, -0.3])[:n], np.array([0.2, -0.1])[:n]
    tau = -side * N.T @ [2.0, 1.5][:n]  # turns the rotors away from the side at which they are
    function = iteration_function(model.mechanism, StepOptions(dt, control="torque", motors="limited"))
    start = {"q": [*np.zeros(n), *x], "v": [*yd, *xd], "diverged": 0.0, "target": tau}
    result = function(**start, iterate=np.zeros(n + 1))
    assert float(result["unconverged"])

    J, v = np.hstack([N, np.eye(n)]), np.concatenate([yd, xd])  # speeds of rotors
    on_links = np.diag([1.0] * n + [0.0] * n)
    B = J.T @ np.diag([motor.damping for motor in motors]) @ J + 0.03 * on_links
    A = LINK * on_links + inertia * J.T @ J + dt * B
    b = np.hstack([np.eye(n), np.linalg.inv(N)]).T @ tau - B @ v
    for i in range(n):
        meshes = np.array([float(j != i) for j in range(n)])
        slopes = np.diag([*np.zeros(n), *(meshes * dt * (dt * k + d))])
        torques = np.concatenate([np.zeros(n), meshes * (k * (x - side * gap) + (dt * k + d) * xd)])
        expected = np.linalg.solve(A + slopes, b - torques)[n + i]
        assert float(result["iterate_next"][i]) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("figures", MESHES.values(), ids=MESHES)
def test_torque_is_the_slope_of_energy(figures: dict[str, float]):
    model = Model(turntable(40.0, **(figures | {"damping": 0.0})), "elastic")
    y = SX.sym("y", 2)
    energy = mesh_energy(make_scene(model.mechanism, StepOptions(), SX(0, 1), SX(3, 0)), y)
    slope = ca.Function("slope", [y], [ca.gradient(energy, y)])
    step = stepper(model, 1e-9)
    for x in (-0.3, -0.004, 0.006, 0.07):
        rotor = (step([0.0, x], np.zeros(2), [0.0])["v_next"] / 1e-9) @ [RATIO, 1.0]
        assert -ROTOR * rotor == pytest.approx(float(slope([0.0, x])[1]), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("control", ["position", "motor_position"])
def test_position_control_holds_the_rotor_where_its_encoder_has_it_wanted(control: str):
    """A load stretches the transmission: the joint gives way by load / (N^2 k) more than by its gain."""
    robot = elastic(differential(), 7.0, damping=0.5)
    pushed = replace(robot, gains=replace(robot.gains, kd=(("left", 3.0), ("right", 3.0))))
    model, load = Model(pushed, "elastic"), np.array([0.4, -0.3])
    names = {"target": np.zeros(2)}
    springs = replace(
        pushed, bodies=tuple(_loaded(body, dict(zip(("left", "right"), load, strict=True))) for body in pushed.bodies)
    )
    model = Model(springs, "elastic")
    q, v = after(model, 0.02, 20.0, names["target"], control=control)
    assert np.abs(v).max() < 1e-8
    N = np.array([[3.0, 4.0], [3.0, -4.0]])
    of_joints = load - 1e-3 * q[:2]  # a soft spring pulls
    kp = np.diag([5.0, 8.0])
    if control == "motor_position":
        back = np.linalg.inv(N)
        kp = N.T @ np.diag((back.T**2) @ np.diag(kp)) @ N
    expected = np.linalg.solve(kp, of_joints) + np.linalg.inv(N.T @ N) @ of_joints / 7.0
    np.testing.assert_allclose(q[:2], expected, rtol=1e-6)


def _loaded(body, load: dict[str, float]):
    """A body that a soft, long spring pulls with a torque [N m]."""
    soft = 1e-3
    if body.name not in load:
        return body
    return replace(body, joint=replace(body.joint, stiffness=soft, springref=load[body.name] / soft))


def test_parameters_are_those_of_another_robot():
    """Factors on stiffness, damping, backlash and ratios, against robots with such figures."""
    figures = {"damping": 0.02, "backlash": 0.04}
    names = ("drive_stiffness", "drive_damping", "backlash", "ratio")
    step = stepper(Model(turntable(40.0, **figures), "elastic"), 0.003, parameters=names)
    other = turntable(40.0 * 1.5, damping=0.04, backlash=0.03)
    gear = replace(other.constraints[0], coefficients=(("rotor", 1.0), ("table", -RATIO * 1.1)))  # type: ignore[call-arg]
    expected = stepper(Model(replace(other, constraints=(gear,)), "elastic"), 0.003)
    q, v = [0.1, 0.05], [2.0, 1.0]
    found = step(q, v, [0.0], parameters=[1.5, 2.0, 0.75, 1.1])
    for name, value in expected(q, v, [0.0]).items():
        np.testing.assert_allclose(found[name], value, rtol=1e-12)


@pytest.mark.parametrize("level", LEVELS)
def test_other_levels_do_not_know_of_it(level: str):
    """Their models are the same to the instruction."""
    robot = KINDS["gears and a belt"]()
    there, without = Model(elastic(robot, 10.0, backlash=0.1), level), Model(robot, level)
    names = [step_function(model.mechanism, StepOptions(0.005)).serialize() for model in (there, without)]
    assert names[0] == names[1]


def test_a_model_of_the_same_robot_at_another_level():
    """Models of other levels can be made from the robot of an elastic model."""
    robot = elastic(KINDS["gears and a belt"](), 10.0)
    again = Model(Model(robot, "elastic").robot, "exact")
    assert again.robot == robot
    assert Model(again.robot, "elastic").robot == Model(robot, "elastic").robot


def test_a_rigid_robot_has_no_elastic_level():
    rigid: Robot = differential()
    with pytest.raises(ValueError, match="elastic is missing: expected the stiffness of at least one transmission"):
        Model(rigid, "elastic")
