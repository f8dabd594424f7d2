"""What others add to the step: a law, a motor model, an integrator, each one class or table here and one name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from ce_gym import Model, Simulator
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Compliance, LinearContact, TangentialForce, Touch
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.motors import MOTORS, Line
from ce_gym.dynamics.forces.normal import NORMAL_LAWS
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import Ends, Plan, Stage
from ce_gym.dynamics.laws import scene_laws
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.state import Field, Output, State
from ce_gym.envs.task.tasks import VELOCITY
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Motor, Placement, Robot
from ce_gym.sim.kernel_key import laws_key

MASS, DT, DRAG = 2.0, 0.005, 3.0


def block() -> Robot:
    """A block on four feet."""
    inertia = ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02))
    body = Body("block", "link", None, Placement(), Joint("free"), Inertial(MASS, (0.0, 0.0, 0.0), inertia))
    contacts = tuple(ContactSphere(f"{x} {y}", "block", (0.1 * x, 0.1 * y, 0.0), 0.0) for x in (-1, 1) for y in (-1, 1))
    return Robot("block", (body,), contacts=contacts, material=ContactMaterial(2e4, 200.0, 0.5, 0.01, 0.0))


class Oil:
    """Friction of a film: proportional to the speed, without a cone."""

    iterations = 0

    def linearise(self, contact: LinearContact) -> TangentialForce:
        """Return the force at the start of the step and its slope."""
        return TangentialForce(DRAG * contact.sliding, SX(DRAG), SX(3, 1), SX(3, 1))

    def check(self, contact: LinearContact, slip: SX, gain: SX) -> SX:
        """Return that nothing changes."""
        return SX(0)


def test_a_friction_law(monkeypatch: pytest.MonkeyPatch):
    """A block on four feet slows down as an implicit step of the exponential, exactly."""
    monkeypatch.setitem(FRICTION, "oil", Oil())
    sim = Simulator(Model(block()), 1, DT, friction="oil", outputs=())
    depth = MASS * 9.81 / 4 / 2e4
    sim.set_state([0.0, 0.0, -depth, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    speed = 1.0
    for _ in range(40):
        sim.step(np.zeros(0))
        speed /= 1 + DT * 4 * DRAG / MASS
        assert sim.v[0, 3] == pytest.approx(speed, rel=1e-9)
    with pytest.raises(ValueError, match="expected 'tangent' or 'secant' or 'oil'"):
        Simulator(Model(block()), friction="water")
    with pytest.raises(ValueError, match="expected 'tangent' or 'secant' or 'oil'"):
        replace(VELOCITY, friction="water")


class Hardening:
    """A spring whose force grows with the cube of the depth."""

    def force(self, touch: Touch, compliance: Compliance, dt: float) -> tuple[SX, SX]:
        """Return the force at no velocity, and the slope of the spring one step ahead with the damper's."""
        depth = ca.fmax(touch.depth, 0)
        return 1e9 * depth**3, compliance.damping + dt * 3e9 * depth**2


def test_a_law_of_the_normal_force(monkeypatch: pytest.MonkeyPatch):
    """A block comes to rest where four such springs carry it."""
    monkeypatch.setitem(NORMAL_LAWS, "hardening", Hardening())
    sim = Simulator(Model(block()), 1, DT, normal_law="hardening", outputs=("contact_forces",))
    sim.set_state([0.0, 0.0, 0.001, 1.0, 0.0, 0.0, 0.0], np.zeros(6))
    sim.step(np.zeros(0), 1000)
    assert sim.q[0, 2] == pytest.approx(-np.cbrt(MASS * 9.81 / 4 / 1e9), rel=1e-6)
    assert sim.contact_forces[0, :, 2] == pytest.approx([MASS * 9.81 / 4] * 4, rel=1e-6)


class Windage:
    """Motors without limits that lose torque with the square of their speed."""

    at_motors = True

    def limits(self, motor: Motor, speed: SX, strength: SX, dt: float) -> tuple[Line, Line] | None:
        """Return none."""
        return None

    def damping(self, motor: Motor, speed: SX) -> SX:
        """Return the coefficient at the present speed."""
        return 1e-3 * ca.fabs(speed)

    def friction(self, motor: Motor) -> float:
        """Return none."""
        return 0.0

    def drive_friction(self, motor: Motor) -> None:
        """Return none."""

    def bandwidth(self, motor: Motor) -> float:
        """Return that it gives torque at once."""
        return math.inf


def wheel() -> Model:
    """A driven wheel on the world."""
    inertia = ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))
    joint = Joint("revolute", (0.0, 0.0, 1.0))
    body = Body("wheel", "rotor", None, Placement(), joint, Inertial(1.0, (0.0, 0.0, 0.0), inertia))
    return Model(Robot("wheel", (body,), (), ("wheel",), motors=(Motor("wheel"),)))


def test_a_motor_model(monkeypatch: pytest.MonkeyPatch):
    """A wheel runs up to the speed at which its motor loses the whole commanded torque."""
    monkeypatch.setitem(MOTORS, "windage", Windage())
    sim = Simulator(wheel(), 1, DT, control="torque", motors="windage")
    sim.step([0.9], 2000)
    assert sim.v[0, 0] == pytest.approx(np.sqrt(0.9 / 1e-3), rel=1e-9)
    assert sim.torque[0, 0] == pytest.approx(0.0, abs=1e-9)


THIRDS = [Stage(f"third_{i}", start=f"third_{i - 1}" if i > 1 else "", length=1 / 3) for i in (1, 2, 3)]
THIRD_ORDER = Plan(
    3,
    (Stage("coarse"), Stage("half", length=1 / 2), Stage("fine", start="half", length=1 / 2), *THIRDS),
    Ends(
        {"third_3": 9 / 2, "fine": -4.0, "coarse": 1 / 2},
        means={"third_1": 1 / 3, "third_2": 1 / 3, "third_3": 1 / 3},
        error=("third_3", "fine"),
    ),
)
"""Linearly implicit Euler, extrapolated twice: a whole step, two halves, three thirds."""


def swing(method: str, dt: float) -> np.ndarray:
    """Joint angles of a leg that swings for 0.1 s, its motors at their limits."""
    model = Model("planar_leg_linkage")
    sim = Simulator(model, 1, dt, method=method, outputs=())
    sim.step(model.standing_q + 0.05, round(0.1 / dt))
    return sim.q[0]


def test_an_integrator(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(METHODS, "third", THIRD_ORDER)
    exact = swing("rk4", 1e-4)
    errors = [np.linalg.norm(swing("third", dt) - exact) for dt in (0.002, 0.001)]
    assert np.log2(errors[0] / errors[1]) > 2.6


def test_a_changed_law_is_compiled_anew(monkeypatch: pytest.MonkeyPatch):
    """Kernels of user-defined laws are cached by their expressions, not by their names."""
    keys = []
    for drag in (1.0, 2.0, 1.0):
        law = Windage()
        monkeypatch.setattr(law, "damping", lambda motor, speed, drag=drag: SX(drag))
        monkeypatch.setitem(MOTORS, "windage", law)
        options = StepOptions(DT, control="torque", motors="windage")
        keys.append(laws_key(wheel().mechanism, options))
    assert keys[0] == keys[2] != keys[1]


class Damper(ForceLaw):
    """A damper on the base whose force follows its speed with a lag: a law with memory, a parameter and an output."""

    parameters = (Parameter("drag", "damping of the base along x", "N s/m", "1", lambda robot, _: [0.0]),)
    outputs = (Output("drag_force", "N", "force on the base along x"),)

    def declare(self) -> None:
        """Act in scenes with the parameter; remember the lagging speed."""
        self.acts = "drag" in self.options.parameters
        self.fields = (Field("lagging_speed", 1, "m/s", "speed of the base along x, with a lag"),)
        self.output_sizes = {"drag_force": 1}

    def place(self, start: Start) -> LaggingDamper:
        """Return the force at the start of a step."""
        return LaggingDamper(start)


@dataclass
class LaggingDamper(LinearForce, PlacedForce):
    """The force of the damper."""

    start: Start

    def linearise(self, iterate: SX) -> LaggingDamper:
        """Return the force, whatever the iterate."""
        return self

    @property
    def force(self) -> SX:
        """Force along x [N]."""
        return -self.start.scene.values["drag"] * self.start.state["lagging_speed"]

    def add_to(self, loads: Loads) -> None:
        """Add the force to the base, which does not turn."""
        old = loads.bodies.get("block", BodyTerms(SX(6, 6), SX(6, 1)))
        loads.bodies["block"] = BodyTerms(old.inertia, old.force + ca.vertcat(SX(3, 1), self.force, SX(2, 1)))

    def advance(self, motion: Motion) -> dict[str, SX]:
        """Follow the speed with a time constant of 0.1 s."""
        speed, lagging = self.start.state.v[3], self.start.state["lagging_speed"]
        return {"lagging_speed": lagging + self.start.dt / 0.1 * (speed - lagging)}

    def output(self, name: str, motion: Motion, after: State) -> SX:
        """Return the force."""
        return self.force


@pytest.fixture
def damped() -> Iterator[None]:
    scene_laws.add_law(Damper)
    yield
    scene_laws.LAWS.remove(Damper)
    del scene_laws.OUTPUTS["drag_force"], scene_laws.PARAMETERS["drag"]


@pytest.mark.usefixtures("damped")
def test_a_force_law_with_memory_a_parameter_and_an_output():
    """Explicit Euler of `m v' = -d s`, `0.1 s' = v - s`, with another d for each robot; resets and snapshots know s."""
    robot = replace(block(), gravity=(0.0, 0.0, 0.0))
    sim = Simulator(Model(robot), 2, DT, contacts=(), parameters=("drag",), outputs=("drag_force",))
    drag = np.array([3.0, 20.0])
    sim.set_parameter("drag", drag[:, None])
    start = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    for _ in range(2):
        sim.set_state(*start)
        speed, lagging = np.ones(2), np.zeros(2)
        for _ in range(30):
            snapshot = sim.snapshot()
            sim.step(np.zeros(0))
            speed, lagging = speed - DT * drag * lagging / MASS, lagging + DT / 0.1 * (speed - lagging)
            np.testing.assert_allclose(sim.v[:, 3], speed, rtol=1e-12)
        assert snapshot["lagging_speed"].shape == (2, 1)
    sim.restore(snapshot)
    sim.step(np.zeros(0))
    np.testing.assert_allclose(sim.v[:, 3], speed, rtol=1e-12)
    np.testing.assert_allclose(sim.output("drag_force")[:, 0], -drag * snapshot["lagging_speed"][:, 0], rtol=1e-12)
    with pytest.raises(ValueError, match="drag=-1; expected 0 or more"):
        sim.set_parameter("drag", -1.0)
    with pytest.raises(ValueError, match="method='rk4'; expected an implicit one: the state has the speed of the base"):
        Simulator(Model(robot), contacts=(), parameters=("drag",), method="rk4")
