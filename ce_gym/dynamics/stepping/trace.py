"""A time step as a traced function: state in, state out, a robot that has gone astray frozen where it was.

May know everything in this room.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.closure import closures
from ce_gym.dynamics.forces.actuation import actuated_clusters
from ce_gym.dynamics.forces.parameters import parameter_defaults
from ce_gym.dynamics.forces.scene import State, StepOptions, make_scene, symbolic_state, target_names
from ce_gym.dynamics.functions import loop_gap, loop_state, traced
from ce_gym.dynamics.recursion.kinematics import Kinematics, outward_velocity_pass
from ce_gym.dynamics.stepping.energy import mechanical_energy
from ce_gym.dynamics.stepping.methods import METHODS, beyond
from ce_gym.dynamics.stepping.step import Stepped, attempt, hint_count, stacked
from ce_gym.model.mechanism import Mechanism

LOST_LOOP = 1e-5
"""A robot with a loop whose residual is larger has diverged [m]."""
SINGULAR = 1e-3
"""A robot whose loops are nearer than this to a singularity (see `Model.nearness`) has diverged."""
SANE_SPEED = 1e4
"""A robot any of whose velocities is beyond this, or not a number, has diverged [rad/s or m/s]."""
SANE_DISTANCE = 1e6
"""A robot any of whose positions is beyond this, or not a number, has diverged [rad or m]."""


def step_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = ()) -> ca.Function:
    """Trace a step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Names among `OUTPUTS`; what is not asked for costs nothing.

    Returns:
        Function (*state, diverged, *given) -> (*state, diverged, *outputs): `state` are the parts of `State` that the
        scene has; `given` is `target` if there are joints, `parameters` if any are declared, `ground` on a field, and
        `dt` if the options leave it open.
    """
    given = _Given(mechanism, options)
    method = METHODS[options.method]
    stepped = method.step(given.scene, given.state, given.target, given.dt)
    return traced("step", given.inputs(), given.results(stepped, outputs))


def attempt_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = ()) -> ca.Function:
    """Trace one attempt at an Euler step: called again with the hints it leaves, where it says so, it makes the step.

    Returns:
        Function (*state, diverged, *given, hints) -> (*state, diverged, hints, misjudged, *outputs), see
        `step_function`; hints are zero at first, shape (hint_count,).
    """
    given, hints = _Given(mechanism, options), SX.sym("hints", hint_count(mechanism, options))
    stepped = attempt(given.scene, given.state, given.target, given.dt, hints)
    results = given.results(stepped, outputs)
    kept = {name: results.pop(name) for name in list(results) if name.endswith("_next")}
    kept |= {"hints_next": stepped.hints, "misjudged": stepped.misjudged}
    return traced("attempt", given.inputs() | {"hints": hints}, kept | results)


def extrapolation_function(mechanism: Mechanism, options: StepOptions, outputs: Mapping[str, int]) -> ca.Function:
    """Trace what follows from a step and two of half the length, as `Extrapolated` has it.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Sizes of those among `OUTPUTS` that are asked for.

    Returns:
        Function (*state, diverged, *of the steps) -> (*state, diverged, *outputs). Of the steps it is given those parts
        it needs, by names such as `coarse_q`, `fine_v` and `half_torque`: the whole step, the second half and the
        first half. A robot that diverges in one of them stays where it was.
    """
    before = symbolic_state(mechanism, options)
    coarse, fine = (symbolic_state(mechanism, options) for _ in range(2))
    flags = {name: SX.sym(name) for name in ("diverged", "coarse_diverged", "half_diverged", "fine_diverged")}
    inputs = dict(before.items()) | flags
    inputs |= {f"coarse_{name}": getattr(coarse, name) for name in ("q", "v")}
    inputs |= {f"fine_{name}": value for name, value in fine.items()}
    v_fine = fine.v
    fine.q, fine.v = beyond(coarse, fine, mechanism.robot.floating)
    sane = ca.logic_and(ca.sumsqr(fine.v) < SANE_SPEED**2, ca.sum1(stacked(list(flags.values()))) < 0.5)
    results = {f"{name}_next": ca.if_else(sane, getattr(fine, name), value) for name, value in before.items()}
    results["diverged_next"] = ca.if_else(sane, 0, 1)
    for name, size in outputs.items():
        if name == "error":
            results[name] = ca.norm_2(v_fine - coarse.v)
            continue
        told = {stage: SX.sym(name, size) for stage in ("coarse", "half", "fine")}
        if name in AT_START:
            weights = {"coarse": 1.0}
        else:
            weights = {"half": 0.5, "fine": 0.5} if name in MEANS else {"fine": 2.0, "coarse": -1.0}
        inputs |= {f"{stage}_{name}": told[stage] for stage in weights}
        results[name] = sum((weight * told[stage] for stage, weight in weights.items()), SX(0))
    return traced("extrapolation", inputs, results)


OUTPUTS = {
    "torque": "motor torque at each joint, mean over the step [N m or N]",
    "motor_speed": "speed of each motor's rotor at the end of the step [rad/s]",
    "power": "mechanical power of the motors at each joint, end of the step [W]",
    "contact_forces": "force on each contact, mean over the step, world axes [N]",
    "energy": "kinetic, potential and elastic energy at the end of the step, see `mechanical_energy` [J]",
    "error": "estimated error of the step in the velocities, of methods that have one [rad/s or m/s]",
    "loop_gap": "norm of the residuals of the closed loops, start of the step [m or -]",
    "nearness": "distance from a singularity, see `Model.nearness`, start of the step",
}
"""What a step can report, if asked."""
AT_START, MEANS = ("loop_gap", "nearness"), ("torque", "contact_forces")
"""Outputs that belong to the start of a step, or to the whole of it; the others belong to its end."""


class _Given:
    """Symbols of one robot before a step, and what becomes of them."""

    def __init__(self, mechanism: Mechanism, options: StepOptions) -> None:
        robot, n = mechanism.robot, len(options.contacts)
        self.mechanism = mechanism
        self.state, self.diverged = symbolic_state(mechanism, options), SX.sym("diverged")
        self.target = SX.sym("target", len(target_names(mechanism, options.control)))
        defaults = parameter_defaults(robot, options.material, options.parameters)
        self.parameters = SX.sym("parameters", sum(len(default) for default in defaults.values()))
        self.ground = SX.sym("ground", 3, n if options.ground == "field" else 0)
        self.dt: float = SX.sym("dt") if options.dt is None else options.dt  # type: ignore[assignment]  # used as one
        self.scene = make_scene(mechanism, options, self.parameters, self.ground)

    def inputs(self) -> dict[str, SX]:
        given = {"target": self.target, "parameters": self.parameters, "ground": ca.vec(self.ground)}
        given = {name: value for name, value in given.items() if value.numel()}
        given |= {"dt": self.dt} if isinstance(self.dt, SX) else {}
        return dict(self.state.items()) | {"diverged": self.diverged} | given

    def results(self, stepped: Stepped, outputs: tuple[str, ...]) -> dict[str, SX]:
        """State after the step, or as it was if the robot has diverged now or before, and outputs."""
        after = stepped.state
        size = ca.sumsqr(after.v) + ca.sumsqr(after.anchor)
        sane = ca.logic_and(size < SANE_SPEED**2, self.diverged < 0.5)  # false if it is not a number:
        sane = ca.logic_and(sane, ca.sumsqr(after.q) < SANE_DISTANCE**2)  # not all positions act on velocities
        if any(closures(self.mechanism)):
            sane = ca.logic_and(sane, loops_close(self.mechanism, stepped.solved.kinematics, after))
        results = {f"{name}_next": ca.if_else(sane, getattr(after, name), value) for name, value in self.state.items()}
        results["diverged_next"] = ca.if_else(sane, 0, 1)
        return results | {name: ca.vec(self._output(name, stepped)) for name in outputs}

    def _output(self, name: str, stepped: Stepped) -> SX:
        n = len(self.mechanism.robot.independent)
        yd = stepped.state.v[stepped.state.v.numel() - n :]
        kinematics = stepped.solved.kinematics
        if name == "motor_speed":
            return stacked([c.W @ yd[c.rows] for c in actuated_clusters(self.mechanism, kinematics)])
        if name == "power":
            return stepped.torque * yd
        if name == "energy":
            return mechanical_energy(self.scene, stepped.state, self.target)
        if name == "loop_gap":
            return loop_gap(self.mechanism, kinematics)
        return loop_state(kinematics)[1] if name == "nearness" else getattr(stepped, name)


def loops_close(mechanism: Mechanism, before: Kinematics, after: State) -> SX:
    """Return 1 if all closed loops can be assembled at the end of a step, away from singularities; else 0.

    A singularity where branches meet could be stepped over; being halfway to it within one step counts as being there.
    """
    still = SX(*after.v.shape)
    gap, nearness = loop_state(outward_velocity_pass(mechanism, after.q, still, after.dependent))
    away = ca.logic_and(nearness > SINGULAR, nearness > loop_state(before)[1] / 2)
    return ca.logic_and(gap < LOST_LOOP, away)
