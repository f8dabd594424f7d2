"""Plan a jump by iterative LQR on the exact model, and on a simplified one, and show both on the exact one.

A robot with a floating base stands, jumps to a height and is to stand again where it began. The plan, targets of the
joints and feedback on the state, is made on every level that is named; then each is followed on the first of them,
with its feedback and without. Uses public names of ce_gym only, and no name of a robot.

    python train/jump.py mini_cheetah --height 0.25 --level exact armature
"""

from __future__ import annotations

import interruption  # noqa: F401

# isort: split

import argparse
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from console import Parser, above_zero, add_json_argument, markdown, print_result, run
from ilqr import ILQR, Array, Plan, State, chosen

import ce_gym
from ce_gym.viewer import Rollout, write_html

SETTLE, TICK, HOLD = 2.0, 0.005, 2
"""Time to come to rest before a jump, and sub-step [s]; sub-steps for which a target is held."""
TAKE_OFF, APEX, STANDS, END = 0.3, 0.5, 0.95, 1.2
"""When legs are stretched, when it is highest, when it is to stand again, and the end [s]."""
HORIZONS = 0.52, 0.75, 0.85, 1.0, 1.2
"""Ends of the motions that are planned one after the other, each beginning with the one before [s]."""
LEVELS = ("exact", "armature")
CROUCH, PUSH = 1.375, 0.5
"""Factors on the standing pose to begin with, before and at take-off."""
MOST, SMALL, PATIENCE = 60, 1e-3, 6
"""Improvements of a motion at most; those below this share of the cost are small; so many of them end it."""


@dataclass(frozen=True)
class Weights:
    """Of squares: place [1/m^2], turning [1/rad^2], joints [1/rad^2], velocities of base and joints [s^2]."""

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
"""Weight of the squares of targets' distance from the standing pose [1/rad^2]."""


class Jump:
    """The cost of a jump, see `ilqr.Cost`.

    Args:
        model: The robot.
        height: How much higher than it stands the base is to be at the apex [m].
    """

    target_slope = float(np.sqrt(TARGETS))

    def __init__(self, model: ce_gym.Model, height: float) -> None:
        self.standing, self.nv, self.height = model.standing_q, model.nv, height

    def _at(self, i: int) -> tuple[Array, float]:
        """Return square roots of weights by row of [q; v], shape (2 nv,), and the height that is wanted."""
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
    """Jumps of one robot on a level.

    Args:
        robot: Name, or path of its file.
        level: Transmission level.
        height: See `Jump`.
    """

    def __init__(self, robot: str, level: str, height: float) -> None:
        self.model, self.height, self.name = ce_gym.Model(robot, level), height, robot
        if not self.model.robot.floating:
            raise ValueError(f"{robot}: its base cannot move; expected a robot with a floating base")
        self.standing = self.model.standing_q[7:]

    def simulator(self, n: int) -> ce_gym.Simulator:
        """Return n robots whose feet may touch the ground, and whose motors have limits."""
        return ce_gym.Simulator(self.model, n, TICK, contacts="foot", motors="limited", outputs=())

    @cached_property
    def rest(self) -> State:
        """A robot that has come to rest."""
        sim = self.simulator(1)
        sim.step(self.standing, round(SETTLE / TICK))
        return ce_gym.StepDerivatives(sim).state()

    @cached_property
    def solver(self) -> ILQR:
        """What plans; its kernels are compiled."""
        solver = ILQR(self.simulator, Jump(self.model, self.height), self.rest, HOLD)
        solver.linearized(solver.first(self.standing[None]))
        return solver

    def plan(self) -> tuple[Plan, int]:
        """Plan longer and longer parts of the jump, each beginning with the one before; return iterations, too."""
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
        """Return what happens when a robot of this level follows a plan."""
        plan = plan if feedback else replace(plan, gains=np.zeros_like(plan.gains))
        robots = self.solver.candidates
        lengths = np.zeros(robots.simulator.num_envs)
        return chosen(0, *self.solver.follow(plan, np.zeros_like(plan.targets), lengths, robots), plan.gains)

    def rollout(self, motion: Plan, label: str) -> Rollout:
        """Return a motion to look at."""
        times = np.linspace(0.0, TICK * (len(motion.states["q"]) - 1), len(motion.states["q"]))
        return Rollout(
            self.name, self.model.transmission, TICK, times, motion.states["q"], motion.states["v"],
            label=label,
        )  # fmt: skip


def figures(motion: Plan, height: float) -> dict[str, float]:
    """What a motion does: how high, how upright then, and how it stands at the end."""
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
    """Plan, follow, print and write the page."""
    jumpers = {level: Jumper(args.robot, level, args.height) for level in args.level}
    judge = jumpers[args.level[0]]
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
            motions[how] = judge.follow(plan, feedback)
            rollouts.append(judge.rollout(motions[how], f"planned on {level}, {how}"))
        standing = float(judge.rest["q"][0, 2])
        rows += [{"plan": level, "followed": how, **figures(one, standing)} for how, one in motions.items()]
    page = write_html(rollouts, args.page or Path(f"{judge.model.robot.name}_jump.html"), spacing=0.0)
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
    parser.add_argument("--height", type=above_zero, default=0.3, metavar="M", help="of the jump [m] (default 0.3)")
    parser.add_argument(
        "--level", nargs="+", choices=ce_gym.LEVELS, default=list(LEVELS), metavar="LEVEL",
        help="levels to plan on; the first is that on which plans are followed (default: exact armature)",
    )  # fmt: skip
    parser.add_argument("--page", type=Path, metavar="FILE", help="default: <robot>_jump.html")
    add_json_argument(parser)
    args = parser.parse_args(argv)
    return run("jump.py", lambda: jump(args))


if __name__ == "__main__":
    raise SystemExit(main())
