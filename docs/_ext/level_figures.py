"""Figures of the page on transmission levels: torques in the paper's tracking experiment, errors and costs by robot.

Worked out anew whenever the pages are built. May know models, their reports and the tracking benchmark.
"""

from __future__ import annotations

import numpy as np
from drawing import line_chart
from environment_page import percent, table, title
from robot_page import models_of, report_of, shipped

from ce_gym import Model, robots
from ce_gym.bench.paper.tracking import FREQUENCY, STEP, sinusoid
from ce_gym.model.mechanism import LEVELS

LEG, JOINT = "mit_humanoid_leg", "knee_link"


def tracking_figures() -> str:
    """Return a chart of the knee's torque error over one period, and the table of all joints, as Markdown."""
    robot = shipped(LEG)
    models = {level: Model(robot, level, locked_rotors=level == "exact") for level in LEVELS}
    motion = sinusoid(models["exact"].nv)
    torques = {level: model.inverse_dynamics(*motion) for level, model in models.items()}
    exact, joints = torques["exact"], models["exact"].joint_links
    period = slice(0, round(1 / FREQUENCY / STEP) + 1, 8)
    time = np.arange(len(exact))[period] * STEP
    errors = {level: torques[level] - exact for level in LEVELS[1:]}
    lines = {level: error[period, joints.index(JOINT)].tolist() for level, error in errors.items()}
    chart = line_chart(time.tolist(), lines, "time [s]", "error of the knee's torque [N m]")
    rows = []
    for i, joint in enumerate(joints):
        peak = float(np.abs(exact[:, i]).max())
        rms = [float(np.sqrt(np.mean(errors[level][:, i] ** 2))) for level in LEVELS[1:]]
        rows.append((f"`{joint}`", f"{peak:.2f}", *(f"{x:.3f} ({100 * x / peak:.1f} %)" for x in rms)))
    columns = ("joint", "largest exact torque [N m]", *(f"`{level}`, rms error [N m]" for level in LEVELS[1:]))
    return f"```{{raw}} html\n{chart}\n```\n\n{table(columns, rows)}\n"


def acceleration_figures() -> str:
    """Return, for each robot with rotors, the median error of joint accelerations and the cost of each level."""
    rows = []
    for name in robots():
        report = report_of(name)
        if report.errors:
            medians = [percent(error.joints.median) for error in report.errors]
            counts = [model.n_instructions("forward_dynamics") for model in models_of(name).values()]
            cost = [f"{count / counts[2]:.3f}" for count in counts]
            rows.append((f"[{title(name)}](/generated/robots/{name}.md)", *medians, *cost))
    columns = ("robot", *(f"error, `{level}`" for level in LEVELS[1:]), *(f"cost, `{level}`" for level in LEVELS))
    return table(columns, rows) + "\n"
