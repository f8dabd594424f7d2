"""Plan a jump by iterative LQR at several transmission levels, and simulate each plan at the first level.

A robot with a floating base stands, jumps to a height, and stands again at the same place. A plan has joint targets and
state feedback. Each plan is simulated with its feedback and without. Uses public names of ce_gym only, and no
name of a robot.

    python train/jump.py mini_cheetah --height 0.25 --level exact armature
"""

from __future__ import annotations

# isort: split

import argparse
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from ilqr import ILQR, Array, Plan, State, select

import ce_gym
from ce_gym.__main__ import run
from ce_gym.console import Parser, above_zero, add_json_argument, markdown, path, print_result
from ce_gym.learn.commands.errors import in_one_line
from ce_gym.viewer import Rollout, write_html

SETTLE, TICK, HOLD = 2.0, 0.005, 2
"""Time to come to rest before a jump [s], sub-step [s], and sub-steps in a control step."""
TAKE_OFF, APEX, STANDS, END = 0.3, 0.5, 0.95, 1.2
"""Times of take-off, of the apex, from which the robot should stand, and of the end [s]."""
HORIZONS = 0.52, 0.75, 0.85, 1.0, 1.2
"""Ends of the planned motions [s]; each plan starts with the result of the one before."""
LEVELS = ("exact", "armature")
CROUCH, PUSH = 1.375, 0.5
"""Factors on the standing pose in the initial guess, before and at take-off."""
MOST, SMALL, PATIENCE = 60, 1e-3, 6
"""Largest number of iterations; relative decrease of the cost that is small; small decreases that end a plan."""


@dataclass(frozen=True)
class Weights:
    """Weights of squared errors: position [1/m^2], orientation, joints [1/rad^2], velocities of base, joints [s^2]."""

    place: float
    turning: float
    joints: float
    base: float
    speed: float


ALONG = Weights(0.5, 2.0, 0.1, 0.05, 0.01)
HIGHEST = Weights(1000.0, 10.0, 0.1, 0.1, 0.01)
STANDING = Weights(5.0, 5.0, 1.0, 0.5, 0.05)
LAST = Weights(30.0, 30.0, 5.0, 3.0, 0.3)
TARGETS = 0.01
"""Weight of the squared distance of targets from the standing pose [1/rad^2]."""


class Jump:
    """The cost of a jump, see `ilqr.Cost`.

    Args:
        model: Model of the robot.
        height: Height of the base at the apex above its standing height [m].
    """

    target_slope = float(np.sqrt(TARGETS))

    def __init__(self, model: ce_gym.Model, height: float) -> None:
        self.standing, self.nv, self.height = model.standing_q, model.nv, height

    def _at(self, i: int) -> tuple[Array, float]:
        """Return square roots of the weights of [q; v], shape (2 nv,), and the desired height [m]."""
        t, end, joints = i * HOLD * TICK, round(END / (HOLD * TICK)), self.nv - 6
        apex = abs(i - round(APEX / (HOLD * TICK))) <= 1
        w = HIGHEST if apex else LAST if i == end else STANDING if t > STANDS + 1e-9 else ALONG
        up = w.place if apex or t > STANDS + 1e-9 else 0.0
        base = [w.turning] * 3 + [w.place, w.place, up]
        every = [*base, *[w.joints] * joints, *[w.base] * 6, *[w.speed] * joints]
        return np.sqrt(every), self.standing[2] + self.height * apex

    def residuals(self, i: int, q: Array, v: Array) -> Array:
        """See `ilqr.Cost`."""
        weights, height = self._at(i)
        place = q[:, :3] - [self.standing[0], self.standing[1], height]
        turned = 2 * np.sign(q[:, 3:4]) * q[:, 4:7]
        return weights * np.hstack([turned, place, q[:, 7:] - self.standing[7:], v])

    def slopes(self, i: int, q: Array, v: Array) -> Array:
        """See `ilqr.Cost`."""
        w, (x, y, z) = q[0, 3], q[0, 4:7]
        cross, J = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(2 * self.nv)
        J[:3, :3] = np.sign(w) * (w * np.eye(3) + cross)
        J[3:6, 3:6] += 2 * w * cross + 2 * cross @ cross
        return self._at(i)[0][:, None] * J

    def target_residuals(self, i: int, targets: Array) -> Array:
        """See `ilqr.Cost`."""
        return self.target_slope * (targets - self.standing[7:])


class Jumper:
    """Planner and simulation of jumps of one robot at one level.

    Args:
        robot: Name of the robot, or path of its file.
        level: Transmission level.
        height: See `Jump`.
    """

    def __init__(self, robot: str, level: str, height: float) -> None:
        self.model, self.height, self.name = ce_gym.Model(robot, level), height, robot
        if not self.model.robot.floating:
            raise ValueError(f"{robot}: its base cannot move; expected a robot with a floating base")
        self.standing = self.model.standing_q[7:]

    def simulator(self, n: int) -> ce_gym.Simulator:
        """Return a simulator of n robots with contacts of the feet and motor limits."""
        return ce_gym.Simulator(self.model, n, TICK, contacts="foot", motors="limited", outputs=())

    @cached_property
    def rest(self) -> State:
        """State of a robot that stands at rest."""
        sim = self.simulator(1)
        sim.step(self.standing, round(SETTLE / TICK))
        return ce_gym.StepDerivatives(sim).state()

    @cached_property
    def solver(self) -> ILQR:
        """Solver with compiled kernels."""
        solver = ILQR(self.simulator, Jump(self.model, self.height), self.rest, HOLD)
        solver.linearized(solver.first(self.standing[None]))
        return solver

    def plan(self) -> tuple[Plan, int]:
        """Plan increasing parts of the jump; return the plan and the number of iterations."""
        n, plan, solver, count = round(END / (HOLD * TICK)), None, self.solver, 0
        guess = np.tile(self.standing, (n, 1))
        off = round(TAKE_OFF / (HOLD * TICK))
        guess[: off * 3 // 5] *= CROUCH
        guess[off * 3 // 5 : off] *= PUSH
        for end in HORIZONS:
            known = guess[:0] if plan is None else plan.targets
            plan = solver.first(np.vstack([known, guess[len(known) : round(end / (HOLD * TICK))]]))
            solver.damping, small = 1.0, 0
            for _ in range(MOST):
                better = solver.improved(plan)
                if better is None:
                    break
                small = small + 1 if plan.cost - better.cost < SMALL * plan.cost else 0
                plan, count = better, count + 1
                if small == PATIENCE:
                    break
        assert plan is not None
        return solver.with_feedback(plan), count

    def follow(self, plan: Plan, feedback: bool) -> Plan:
        """Return the motion of a robot of this level that follows a plan, with or without feedback."""
        plan = plan if feedback else replace(plan, gains=np.zeros_like(plan.gains))
        robots = self.solver.candidates
        lengths = np.zeros(robots.simulator.num_envs)
        return select(0, *self.solver.follow(plan, np.zeros_like(plan.targets), lengths, robots), plan.gains)

    def rollout(self, motion: Plan, label: str) -> Rollout:
        """Return a motion as a rollout."""
        times = np.linspace(0.0, TICK * (len(motion.states["q"]) - 1), len(motion.states["q"]))
        return Rollout(
            self.name, self.model.transmission, TICK, times, motion.states["q"], motion.states["v"],
            label=label,
        )  # fmt: skip


def figures(motion: Plan, height: float) -> dict[str, float]:
    """Return height and tilt at the apex and at the end, distance and speed at the end, and cost of a motion."""
    q, v = motion.states["q"], motion.states["v"]
    top, tilt = int(q[:, 2].argmax()), np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(q[:, 4:6], axis=1), 1)))
    return {
        "apex": q[top, 2] - height,
        "tilt at apex": tilt[top],
        "height at the end": q[-1, 2] - height,
        "tilt at the end": tilt[-1],
        "way": float(np.hypot(*q[-1, :2])),
        "speed at the end": float(np.linalg.norm(v[-1, 3:6])),
        "cost": motion.cost,
    }


UNITS = {"apex": "m", "tilt at apex": "deg", "height at the end": "m", "tilt at the end": "deg", "way": "m",
         "speed at the end": "m/s"}  # fmt: skip


def jump(args: argparse.Namespace) -> int:
    """Plan, simulate, print the results and write the page."""
    jumpers = {level: Jumper(args.robot, level, args.height) for level in args.level}
    evaluator = jumpers[args.level[0]]
    rows, rollouts, times = list[dict[str, float | str]](), list[Rollout](), dict[str, dict[str, float]]()
    for level, jumper in jumpers.items():
        _ = jumper.solver
        wall, processor = time.perf_counter(), time.process_time()
        plan, count = jumper.plan()
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        times[level] = {"iterations": count, "wall [s]": wall, "processor [s]": processor}
        motions = {f"as planned, on {level}": plan}
        for feedback in (True, False):
            how = f"on {args.level[0]}, {'with feedback' if feedback else 'targets alone'}"
            motions[how] = evaluator.follow(plan, feedback)
            rollouts.append(evaluator.rollout(motions[how], f"planned on {level}, {how}"))
        standing = float(evaluator.rest["q"][0, 2])
        rows += [{"plan": level, "followed": how, **figures(one, standing)} for how, one in motions.items()]
    page = write_html(rollouts, args.html or Path(f"{evaluator.model.robot.name}_jump.html"), spacing=0.0)
    print_result({"times": times, "motions": rows, "page": str(page)}, _text(rows, times, page), args.json)
    return 0


def _text(rows: list[dict[str, float | str]], times: dict[str, dict[str, float]], page: Path) -> str:
    heading = [f"{name} [{UNITS[name]}]" if name in UNITS else name for name in rows[0]]
    cells = [[x if isinstance(x, str) else f"{x:.3f}" for x in row.values()] for row in rows]
    spent = [
        f"{level}: {one['iterations']} iterations, {one['wall [s]']:.1f} s, {one['processor [s]']:.1f} s of processors"
        for level, one in times.items()
    ]
    return "\n".join([markdown([heading, *cells]), *spent, str(page)])


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(description="Plan a jump by iterative LQR, and show it.")
    parser.add_argument("robot", metavar="ROBOT", help="name or path of a robot with a floating base")
    parser.add_argument(
        "--height", type=above_zero, default=0.3, metavar="M", help="height of the jump [m] (default 0.3)"
    )
    parser.add_argument(
        "--level", nargs="+", choices=ce_gym.LEVELS, default=list(LEVELS), metavar="LEVEL",
        help="levels of the plans; all plans are simulated at the first level (default: exact armature)",
    )  # fmt: skip
    parser.add_argument("--html", type=path, metavar="FILE", help="default: <robot>_jump.html")
    add_json_argument(parser)
    args = parser.parse_args(argv)
    return run(in_one_line(lambda: jump(args)))


if __name__ == "__main__":
    raise SystemExit(main())
