"""Declared parameters: each is the figure it says it is, and one that is not declared is not there."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Simulator
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.laws.scene_laws import PARAMETERS
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Body, Elasticity, Inertial, Joint, LinearConstraint, Motor, Placement, Robot, load_robot
from ce_gym.model.drives import ELASTIC_FACTORS
from ce_gym.model.mechanism import ELASTIC, LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

BASE, ARM = "plate", "forearm"
NAMES = [name.replace("BODY", body) for name in PARAMETERS for body in (BASE, ARM)[: 1 + ("BODY" in name)]]
NAMES = [name.replace("ROTOR", "elbow_rotor") for name in NAMES if name not in [f"{k}:ROTOR" for k in ELASTIC_FACTORS]]


@pytest.fixture(scope="module")
def tripod() -> Robot:
    return load_robot(TRIPOD)


@pytest.fixture(scope="module")
def states(tripod: Robot) -> list[dict[str, np.ndarray]]:
    """Robots that stand and slide on their feet, some motors saturated."""
    rng, model, found = np.random.default_rng(4), Model(tripod), []
    for _ in range(6):
        q, v = model.standing_q.copy(), rng.normal(0, 0.3, model.nv)
        q[2] -= 0.004
        q[7:] += rng.normal(0, 0.02, 2)
        load, anchor = rng.uniform(5, 40, 3), rng.normal(0, 2e-4, 6)
        target = q[7:] + rng.normal(0, 1.5, 2)
        found.append({"q": q, "v": v, "load": load, "anchor": anchor, "diverged": np.zeros(1), "target": target})
    return found


@lru_cache
def stepper(robot: Robot, level: str, parameters: tuple[str, ...], **options) -> ca.Function:
    feet = tuple(contact.name for contact in robot.contacts if contact.group == "foot")
    scene = StepOptions(0.005, contacts=feet, material=robot.material, parameters=parameters, **options)
    return step_function(Model(robot, level).mechanism, scene, ("torque", "contact_forces"))


def results(robot: Robot, states, level: str = "exact", values: dict | None = None, **options) -> list[dict]:
    """The results of a step from each state, with parameters `values`."""
    function = stepper(robot, level, tuple(values or ()), **options)
    given = {"parameters": np.concatenate([np.ravel(x) for x in values.values()])} if values else {}
    return [{name: x.full() for name, x in function(**state, **given).items()} for state in states]


def assert_same(ours: list[dict], theirs: list[dict]) -> None:
    for a, b in zip(ours, theirs, strict=True):
        for name, value in b.items():
            np.testing.assert_allclose(a[name], value, rtol=1e-9, atol=1e-9, err_msg=name)


def assert_different(ours: list[dict], theirs: list[dict]) -> None:
    assert max(np.abs(a["v_next"] - b["v_next"]).max() for a, b in zip(ours, theirs, strict=True)) > 1e-4


def with_inertial(robot: Robot, body: str, **changes) -> Robot:
    bodies = (replace(b, inertial=replace(b.inertial, **changes)) if b.name == body else b for b in robot.bodies)
    return replace(robot, bodies=tuple(bodies))


@pytest.mark.parametrize("name", ["friction", "stiffness", "damping"])
def test_contact_figures(tripod: Robot, states, name: str):
    value = 0.6 * getattr(tripod.material, name)
    other = replace(tripod, material=replace(tripod.material, **{name: value}))
    assert_same(results(tripod, states, values={name: value}), results(other, states))
    assert_different(results(other, states), results(tripod, states))


def test_gravity(tripod: Robot, states):
    slope = (1.0, -2.0, -9.0)
    other = replace(tripod, gravity=slope)
    assert_same(results(tripod, states, values={"gravity": slope}), results(other, states))
    assert_different(results(other, states), results(tripod, states))


@pytest.mark.parametrize("name", ["kp", "kd"])
def test_gains(tripod: Robot, states, name: str):
    values = np.linspace(3.0, 9.0, 2)
    gains = replace(tripod.gains, **{name: tuple(zip(tripod.independent, values, strict=True))})
    other = replace(tripod, gains=gains)
    assert_same(results(tripod, states, values={name: values}), results(other, states))
    assert_different(results(other, states), results(tripod, states))


@pytest.mark.parametrize("motors", ["ideal", "limited"])
def test_motor_strength_weakens_gains_and_limits(tripod: Robot, states, motors: str):
    """A strength of 70 % scales gains and torque limits by 0.7."""
    strength = 0.7
    scaled = replace(
        tripod,
        gains=replace(
            tripod.gains,
            kp=tuple((n, strength * x) for n, x in tripod.gains.kp),
            kd=tuple((n, strength * x) for n, x in tripod.gains.kd),
        ),
        bodies=tuple(replace(b, joint=replace(b.joint, torque=strength * b.joint.torque)) for b in tripod.bodies),
        motors=tuple(replace(m, torque=strength * m.torque) for m in tripod.motors),
    )
    ours = results(tripod, states, values={"motor_strength": strength}, motors=motors)
    assert_same(ours, results(scaled, states, motors=motors))
    limits = strength * np.array([tripod.body(name).joint.torque for name in tripod.independent])
    assert (np.abs([r["torque"][:, 0] for r in ours]) > 0.95 * limits).sum() > 3, "some motors are at their limits"


@pytest.mark.parametrize("body", [BASE, ARM])
def test_ballast(tripod: Robot, states, body: str):
    inertial = tripod.body(body).inertial
    mass, shift = inertial.mass + 0.4, np.array([0.01, -0.02, 0.005])
    other = with_inertial(tripod, body, mass=mass, com=tuple(np.array(inertial.com) + shift))
    values = {f"added_mass:{body}": 0.4, f"com_shift:{body}": shift}
    assert_same(results(tripod, states, values=values), results(other, states))
    assert_same(results(tripod, states, values=dict(reversed(values.items()))), results(other, states))
    only = with_inertial(tripod, body, mass=mass)
    assert_same(results(tripod, states, values={f"added_mass:{body}": 0.4}), results(only, states))
    assert_different(results(only, states), results(other, states))


@pytest.mark.parametrize("figure", ["damping", "friction"])
@pytest.mark.parametrize("whose", ["motor", "joint"])
def test_losses_of_motors_and_joints(tripod: Robot, states, whose: str, figure: str):
    values = (3e-3, 7e-3) if whose == "motor" else (0.05, 0.13)
    if whose == "motor":
        each = zip(tripod.motors, values, strict=True)
        other = replace(tripod, motors=tuple(replace(motor, **{figure: value}) for motor, value in each))
    else:
        own = dict(zip(tripod.independent, values, strict=True))
        joints = (replace(b.joint, **{figure: own[b.name]}) if b.name in own else b.joint for b in tripod.bodies)
        other = replace(tripod, bodies=tuple(replace(b, joint=j) for b, j in zip(tripod.bodies, joints, strict=True)))
    ours = results(tripod, states, values={f"{whose}_{figure}": values}, motors="limited")
    assert_same(ours, results(other, states, motors="limited"))
    assert_different(ours, results(tripod, states, motors="limited"))


def test_link_inertia_is_that_about_the_centre_of_mass(tripod: Robot, states):
    inertial = tripod.body(ARM).inertial
    other = with_inertial(tripod, ARM, inertia=tuple(map(tuple, (1.4 * np.array(inertial.inertia)).tolist())))
    ours = results(tripod, states, values={f"link_inertia:{ARM}": 1.4})
    assert_same(ours, results(other, states))
    both = {f"link_inertia:{ARM}": 1.4, f"added_mass:{ARM}": 0.4}
    heavy = with_inertial(other, ARM, mass=inertial.mass + 0.4)
    assert_same(results(tripod, states, values=both), results(heavy, states))
    assert_different(ours, results(tripod, states))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ELASTIC_FACTORS)
def test_figures_of_one_elastic_drive(kind: str):
    leg = load_robot("mini_cheetah")
    one = next(elastic for elastic in leg.elastic if elastic.rotor == "HR_knee_rotor")
    figure = kind.removeprefix("drive_")
    others = (replace(e, **{figure: 1.3 * getattr(e, figure)}) if e is one else e for e in leg.elastic)
    soft, rng = Model(replace(leg, elastic=tuple(others)), "elastic"), np.random.default_rng(0)
    model = Model(leg, "elastic")
    q, v = model.standing_q + np.r_[np.zeros(19), rng.normal(0, 0.05, 12)], rng.normal(0, 1.0, model.nv)
    plain = StepOptions(0.002, control="torque")
    declared = step_function(model.mechanism, replace(plain, parameters=(f"{kind}:HR_knee_rotor",)))
    given = {"q": q, "v": v, "diverged": 0.0, "target": np.zeros(12)}
    ours, theirs = declared(**given, parameters=1.3)["v_next"], step_function(soft.mechanism, plain)(**given)["v_next"]
    np.testing.assert_allclose(ours.full(), theirs.full(), rtol=1e-9, atol=1e-9)
    assert np.abs((ours - declared(**given, parameters=1.0)["v_next"]).full()).max() > 1e-3


TILTED = ((4e-5, 5e-6, 3e-6), (5e-6, 5e-5, -4e-6), (3e-6, -4e-6, 3e-5))
SHAPES = {"as it is": {}, "tilted": {"inertia": TILTED}, "eccentric": {"com": (0.01, 0.012, 0.005)}}
"""Of rotors: those about no principal axis are bodies of the recursion at the exact level."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "which", "shape"),
    [*(("exact", which, shape) for which in ("all", "one") for shape in SHAPES)]
    + [(level, *case) for level in ("coupled", "armature") for case in (("all", "eccentric"), ("one", "tilted"))],
)
def test_rotor_inertia_is_that_of_the_spin(tripod: Robot, states, level: str, which: str, shape: str):
    """The factor scales the inertia about the rotor's axis; the inertia that its carrier bears stays."""
    for rotor in tripod.rotors():
        tripod = with_inertial(tripod, rotor.name, **SHAPES[shape])
    factor, other = 1.5, tripod
    for rotor in list(tripod.rotors())[1 if which == "one" else 0 :]:
        axis, tensor = np.array(rotor.joint.axis), np.array(rotor.inertial.inertia)
        offset = np.linalg.norm(np.cross(axis, rotor.inertial.com))
        spin = axis @ tensor @ axis + rotor.inertial.mass * offset**2
        more = (factor - 1) * spin * np.outer(axis, axis)
        other = with_inertial(other, rotor.name, inertia=tuple(map(tuple, (tensor + more).tolist())))
        R = np.array(rotor.placement.rotation)
        kept = np.array(other.body(rotor.parent).inertial.inertia) - R @ more @ R.T
        other = with_inertial(other, rotor.parent, inertia=tuple(map(tuple, kept.tolist())))
    name = "rotor_inertia" if which == "all" else "rotor_inertia:elbow_rotor"
    ours = results(tripod, states, level, {name: factor})
    assert_same(ours, results(other, states, level))
    assert_different(ours, results(tripod, states, level))


@pytest.mark.parametrize("level", [ELASTIC, "exact", "coupled", "armature"])
@pytest.mark.parametrize("offset", [0.0, 0.01])
def test_a_geared_arm_with_an_unbalanced_rotor(level: str, offset: float):
    """`vdot = tau / (I + N^2 J f)`, with J the moment about the axis, and its derivative by f."""
    ratio, arm, spring, tau, factor = 8.0, 0.02, 5e3, 1.3, 0.4
    turning = Joint("revolute", (0.0, 1.0, 0.0))
    link = Inertial(1.0, (0.0, 0.0, 0.0), ((0.02, 0.0, 0.0), (0.0, arm, 0.0), (0.0, 0.0, 0.02)))
    unbalanced = Inertial(0.05, (offset, 0.2, 0.0), TILTED)
    bodies = (
        Body("arm", "link", None, Placement(), turning, link),
        Body("rotor", "rotor", None, Placement(), turning, unbalanced),
    )
    gear = LinearConstraint("gear", (("rotor", 1.0), ("arm", -ratio)))
    given = {"motors": (Motor("rotor"),), "gravity": (0.0, 0.0, 0.0), "elastic": (Elasticity("rotor", spring),)}
    robot, J = Robot("geared", bodies, (gear,), ("arm",), **given), 5e-5 + 0.05 * offset**2
    model = Model(robot, level)
    derivatives = model.derivatives("forward_dynamics", wrt=["rotor_inertia"])
    slope = derivatives.jacobian(np.zeros(model.nq), np.zeros(model.nv), np.r_[tau, 0.0][: model.nv])
    if level != ELASTIC:
        expected = -tau * ratio**2 * J / (arm + ratio**2 * J) ** 2
        assert slope["vdot", "rotor_inertia"].item() == pytest.approx(expected, rel=1e-9)
    sim = Simulator(model, dt=1e-5, control="torque", parameters=("rotor_inertia",))
    sim.set_parameter("rotor_inertia", factor)
    sim.step([tau], 4000)
    assert sim.v[0, 0] == pytest.approx(tau * 0.04 / (arm + ratio**2 * J * factor), rel=2e-3)
    least = 1 - 1 / (J * np.linalg.inv(TILTED)[1, 1])
    sim.set_parameter("rotor_inertia", least + 1e-6)
    with pytest.raises(ValueError, match=f"rotor_inertia={least - 1e-4:g}; expected {least:g} or more, .* rotor"):
        sim.set_parameter("rotor_inertia", least - 1e-4)


def with_ratios(robot: Robot, factor: float) -> Robot:
    """Every rotor turns so much further for a motion of the links."""
    rotors = {rotor.name for rotor in robot.rotors()}

    def regeared(tie):
        if not rotors & set(tie.bodies):
            return tie
        assert isinstance(tie, LinearConstraint)
        return replace(tie, coefficients=tuple((b, x if b in rotors else factor * x) for b, x in tie.coefficients))

    return replace(robot, constraints=tuple(regeared(tie) for tie in robot.constraints))


@pytest.mark.slow
@pytest.mark.parametrize("motors", ["ideal", "limited"])
@pytest.mark.parametrize("level", LEVELS)
def test_ratio_is_that_of_every_gear(tripod: Robot, states, level: str, motors: str):
    other = with_ratios(tripod, 1.2)
    ours = results(tripod, states, level, {"ratio": 1.2}, motors=motors)
    assert_same(ours, results(other, states, level, motors=motors))
    if (level, motors) != ("none", "ideal"):  # there a ratio means nothing
        assert_different(ours, results(tripod, states, level, motors=motors))


def geared_linkage() -> Robot:
    """A linkage whose driven joint, on which others depend by a loop, has a rotor on the thigh."""
    linkage, leg = load_robot("planar_leg_linkage"), load_robot("mit_humanoid_leg")
    rotor = replace(next(leg.rotors()), name="rotor", parent="thigh")
    tie = LinearConstraint("gear", (("rotor", 1.0), ("shank_driver", -6.0)))
    return replace(linkage, bodies=(*linkage.bodies, rotor), constraints=(*linkage.constraints, tie))


def without_offsets(robot: Robot) -> Robot:
    """All rotors at zero where the joints are: a ratio says how far rotors turn from there, not where it is."""
    return replace(robot, constraints=tuple(replace(tie, offset=0.0) for tie in robot.constraints))


@pytest.mark.parametrize("which", ["belts", "lopsided", "loop"])
def test_ratio_where_belts_and_loops_are_between(which: str, awkward_robot):
    """Rotors that turn with several joints, lopsided ones, and those behind loops; with a body of their own or not."""
    robots = {
        "belts": lambda: load_robot("mit_humanoid_leg"),
        "lopsided": lambda: without_offsets(awkward_robot(lopsided=1e-3)),
        "loop": geared_linkage,
    }
    factor, rng, robot = 0.85, np.random.default_rng(0), robots[which]()
    for eliminate in (True, False):
        model = Model(robot, eliminate_rotors=eliminate)
        geared = Model(with_ratios(robot, factor), eliminate_rotors=eliminate)
        joints = len(model.joint_links)
        q, v = model.standing_q.copy(), rng.normal(0, 1.0, model.nv)
        q[-joints:] += rng.uniform(-0.1, 0.1, joints)
        given = {"q": q, "v": v, "diverged": 0.0, "target": rng.normal(0, 30.0, joints)}
        given |= {"dependent": model.dependent_guess(q)} if model.guess.size else {}
        plain = StepOptions(0.002, control="torque", motors="limited")
        declared = step_function(model.mechanism, replace(plain, parameters=("ratio",)), ("torque", "motor_speed"))
        ours = declared(**given, parameters=factor)
        theirs = step_function(geared.mechanism, plain, ("torque", "motor_speed"))(**given)
        nominal = step_function(model.mechanism, plain)(**given)
        for key, value in theirs.items():
            np.testing.assert_allclose(ours[key].full(), value.full(), rtol=1e-8, atol=1e-8, err_msg=key)
        assert np.abs((ours["v_next"] - nominal["v_next"]).full()).max() > 1e-3


def test_ratio_needs_rotors_that_follow(tripod: Robot):
    rotor = next(tripod.rotors()).name
    link = next(dict(tie.coefficients) for tie in tripod.constraints if rotor in tie.bodies)
    joint = next(name for name in link if name != rotor)
    turned = replace(tripod, independent=tuple(rotor if name == joint else name for name in tripod.independent))
    with pytest.raises(ValueError, match=f"parameters='ratio': {rotor} of tripod; expected rotors that follow"):
        parameter_defaults(turned, turned.material, ("ratio",))


def test_rotor_inertia_means_nothing_where_rotors_do_not_spin(tripod: Robot, states):
    ours = results(tripod, states, "none", {"rotor_inertia": 3.0})
    assert_same(ours, results(tripod, states, "none"))


@pytest.mark.parametrize("level", ["exact", "armature"])
def test_defaults_change_nothing(tripod: Robot, states, level: str):
    defaults = parameter_defaults(tripod, tripod.material, tuple(NAMES))
    assert_same(results(tripod, states, level, defaults), results(tripod, states, level))


FEET_ITERATION, FEET_STEP = 9478, 33704
"""Instructions of a sub-step of Mini Cheetah on its feet, as a kernel makes it and with all its iterations unrolled.

As counted when parameters, limited motors, fields and the methods of higher order were there but not asked for. A
feature that is not asked for must not add to them; whoever makes the step cheaper may lower them."""


def test_undeclared_parameters_add_no_instructions():
    model = Model("mini_cheetah")
    feet = tuple(contact.name for contact in model.robot.contacts if contact.group == "foot")
    plain = StepOptions(0.005, contacts=feet)
    iteration = partial(iteration_function, conserves=False)
    for trace, most in ((iteration, FEET_ITERATION), (step_function, FEET_STEP)):
        function = trace(model.mechanism, plain)
        assert function.n_instructions() <= most
        assert not {"parameters", "ground"} & set(function.name_in())
    for more in ({"parameters": ("kp",)}, {"motors": "limited"}, {"ground": "field"}):
        function = iteration(model.mechanism, replace(plain, **more))
        assert function.n_instructions() > FEET_ITERATION, more


def test_robots_have_their_own_values(tripod: Robot):
    """Each robot of a batch moves, bit for bit, as it moves alone with its values."""
    model, rng, names = Model(tripod), np.random.default_rng(0), ("friction", "gravity", f"added_mass:{BASE}", "kp")
    values = {
        "friction": rng.uniform(0.2, 1.0, (10, 1)),
        "gravity": rng.normal(0, 1, (10, 3)) + [0, 0, -9.0],
        f"added_mass:{BASE}": rng.uniform(0, 3, (10, 1)),
        "kp": rng.uniform(10, 30, (10, 2)),
    }
    sim = Simulator(model, 10, parameters=names)
    for name in names:
        sim.set_parameter(name, values[name])
    sim.reset()
    sim.step(model.standing_q[7:], 40)
    assert np.ptp(sim.q, axis=0)[:3].min() > 1e-4
    for i in (0, 7, 8, 9):
        alone = Simulator(model, 1, parameters=names)
        for name in names:
            alone.set_parameter(name, values[name][i])
        alone.reset()
        alone.step(model.standing_q[7:], 40)
        np.testing.assert_array_equal(alone.q[0], sim.q[i])
        np.testing.assert_array_equal(alone.v[0], sim.v[i])


def test_setting_some_robots_leaves_the_others(tripod: Robot):
    model = Model(tripod)
    mask = np.arange(10) % 3 == 0
    sims = [Simulator(model, 10, parameters=("motor_strength",)) for _ in range(2)]
    sims[1].set_parameter("motor_strength", 0.3, mask)
    for sim in sims:
        sim.step(model.standing_q[7:] + 0.1, 10)
    np.testing.assert_array_equal(sims[0].q[~mask], sims[1].q[~mask])
    assert (sims[0].q[mask] != sims[1].q[mask]).any(axis=1).all()


def test_stiffness_is_known_to_the_robot_at_rest(tripod: Robot):
    """The initial load of contacts depends on the stiffness of each robot's ground."""
    model = Model(tripod)
    soft = Model(replace(tripod, material=replace(tripod.material, stiffness=2e4)))
    ours, theirs = Simulator(model, 3, parameters=("stiffness",)), Simulator(soft, 3)
    ours.set_parameter("stiffness", 2e4)
    q = model.standing_q.copy()
    q[2] -= 0.002
    for sim in (ours, theirs):
        sim.set_state(q, np.zeros(model.nv))
        sim.step(model.standing_q[7:])
    np.testing.assert_allclose(ours.contact_forces, theirs.contact_forces, rtol=1e-9, atol=1e-9)


def test_errors_name_what_was_expected(tripod: Robot):
    model = Model(tripod)
    sim = Simulator(model, 2, parameters=("friction", f"com_shift:{BASE}"))
    with pytest.raises(ValueError, match=r"parameter 'kp'; expected one of .* friction, com_shift:plate"):
        sim.set_parameter("kp", 1.0)
    with pytest.raises(ValueError, match=r"parameter 'kp'; .* none"):
        Simulator(model, 2).set_parameter("kp", 1.0)
    with pytest.raises(ValueError, match=r"com_shift:plate has shape \(2,\); expected \(\) or \(3,\) or \(2, 3\)"):
        sim.set_parameter(f"com_shift:{BASE}", [0.0, 1.0])
    with pytest.raises(ValueError, match=r"friction=nan; expected 0 or more"):
        sim.set_parameter("friction", np.nan)
    with pytest.raises(ValueError, match=r"mask=.*; expected a bool array of shape \(2,\)"):
        sim.set_parameter("friction", 0.5, np.ones(3, bool))
    with pytest.raises(ValueError, match=r"parameters='colour'; expected one of gravity, .*, BODY being a link"):
        Simulator(model, parameters=("colour",))
    with pytest.raises(ValueError, match=r"parameters='added_mass:elbow_rotor'"):
        Simulator(model, parameters=("added_mass:elbow_rotor",))
