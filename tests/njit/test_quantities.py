"""Quantities of a robot as `@njit` functions: the bits of `Model`, in threads, in cached code, of edited robots."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from ball_joints import with_balls
from linkages import four_bar, spatial_four_bar

from ce_gym import Model, load_robot
from ce_gym.model import Pose

numba = pytest.importorskip("numba")

from ce_gym.numba import forward_dynamics, inverse_dynamics, mass_matrix, quantity  # noqa: E402

METHODS = {
    "forward_dynamics": lambda model, q, v, x: model.forward_dynamics(q, v, x),
    "inverse_dynamics": lambda model, q, v, x: model.inverse_dynamics(q, v, x),
    "mass_matrix": lambda model, q, v, x: model.mass_matrix(q),
    "bias_force": lambda model, q, v, x: model.bias_force(q, v),
    "spanning": lambda model, q, v, x: model.spanning(q, v),
    "implicit_constraint": lambda model, q, v, x: model.implicit_constraint(q, v),
    "body_poses": lambda model, q, v, x: model.body_poses(q),
    "body_velocities": lambda model, q, v, x: model.body_velocities(q, v),
    "contact_points": lambda model, q, v, x: model.contact_points(q, v),
    "contact_accelerations": lambda model, q, v, x: model.contact_accelerations(q, v, x),
    "energy": lambda model, q, v, x: model.energy(q, v),
    "contact_jacobian": lambda model, q, v, x: model.contact_jacobian(q),
    "contact_bias_acceleration": lambda model, q, v, x: model.contact_bias_acceleration(q, v),
    "center_of_mass": lambda model, q, v, x: model.center_of_mass(q),
    "loops": lambda model, q, v, x: (model.dependent_guess(q), model.loop_gap(q), model.nearness(q)),
}
FRAMES = {
    "frame_pose": lambda model, q, v, x: model.frame_pose(q, model.body_names[-1]),
    "frame_velocity": lambda model, q, v, x: model.frame_velocity(q, v, model.body_names[-1]),
    "frame_jacobian": lambda model, q, v, x: model.frame_jacobian(q, model.body_names[-1]),
}
CONTACTS = {
    "contact_points": lambda model, q, v, x: model.contact_points(q, v, model.contact_names[-1:]),
    "contact_jacobian": lambda model, q, v, x: model.contact_jacobian(q, model.contact_names[-1:]),
    "contact_bias_acceleration": lambda model, q, v, x: model.contact_bias_acceleration(q, v, model.contact_names[-1:]),
}
DRIVEN_ROCKERS = {
    "open loop": four_bar(
        independent=("rocker",), pose=Pose(joints=(("rocker", 1.5),)), assembly=(("crank", 0.7), ("coupler", 0.0))
    ),
    "no formula": replace(
        spatial_four_bar(),
        independent=("rocker",),
        pose=Pose(joints=(("rocker", 1.65),)),
        assembly=(("crank", 0.6), ("pitch", -0.2), ("coupler", 0.1)),
    ),
}
"""Four-bar linkages that do not close 2 rad beyond the standing pose."""


@pytest.fixture(scope="module")
def model() -> Model:
    return Model("mini_cheetah")


def state(model: Model, batch: tuple[int, ...] = ()) -> list[np.ndarray]:
    """Random positions, velocities, and forces or accelerations, which are no rows of one another."""
    rng = np.random.default_rng(2)
    q = np.broadcast_to(model.standing_q, (*batch, model.nq)) + rng.uniform(-0.2, 0.2, (*batch, model.nq))
    for i, _ in model.robot.layout.turns:
        q[..., i : i + 4] /= np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
    return [q, *(rng.normal(size=(*batch, model.nv)) for _ in range(2))]


@pytest.mark.parametrize(
    ("name", "place"),
    [
        *((name, None) for name in METHODS),
        *((name, "body") for name in FRAMES),
        *((name, "contact") for name in CONTACTS),
    ],
)
@pytest.mark.parametrize("robot", ["tello", "balls"])
def test_bits_and_shapes_are_those_of_model(name, place, robot):
    model = Model(with_balls(floating=False) if robot == "balls" else robot)
    last = {None: "", "body": f":{model.body_names[-1]}", "contact": f":{','.join(model.contact_names[-1:])}"}
    function = quantity(model, name + last[place])
    method = {None: METHODS, "body": FRAMES, "contact": CONTACTS}[place][name]
    for batch in ((), (2, 5)):
        arguments = state(model, batch)
        found = function(*arguments[: len(signature(function.py_func).parameters)])
        expected = method(model, *arguments)
        found, expected = (x if isinstance(x, tuple) else (x,) for x in (found, expected))
        for a, b in zip(found, expected, strict=True):
            assert np.shape(a) == np.shape(b)
            assert np.array_equal(a, b)


def test_arrays_of_any_order_and_dtype(model):
    q, v, tau = state(model, (6,))
    expected = model.forward_dynamics(q[::2], v[::2], tau[::2].astype(np.float32))
    function = forward_dynamics(model)
    assert np.array_equal(function(q[::2], np.asfortranarray(v)[::2], tau[::2].astype(np.float32)), expected)
    single = Model("mini_cheetah", dtype="float32")
    found = forward_dynamics(single)(q, v, tau)
    assert found.dtype == np.float32
    assert np.array_equal(found, single.forward_dynamics(q, v, tau))


def test_wrong_shapes_are_refused(model):
    q, v, tau = state(model, (4,))
    function = forward_dynamics(model)
    wrong = (q, v[:3], tau), (q, v[:, 1:], tau), (q[:, 1:], v, tau), (q, v[0], tau), (q, v, np.zeros((18, 4)))
    for arguments in wrong:
        with pytest.raises(
            ValueError, match=r"forward_dynamics: expected q \(..., 19\), v \(..., 18\), tau \(..., 18\)"
        ):
            function(*arguments)


@pytest.mark.parametrize("case", ["quaternion", "not finite", "open loop", "no formula"])
@pytest.mark.parametrize("name", ["mass_matrix", "implicit_constraint", "frame_pose"])
def test_rows_without_a_result_are_not_numbers(name, case):
    """All results of a robot are nan, those that do not depend on the wrong number, too; others keep their bits."""
    model = Model(DRIVEN_ROCKERS.get(case, "mini_cheetah"))
    full = f"{name}:{model.body_names[0]}" if name == "frame_pose" else name
    function, q = quantity(model, full), np.tile(model.standing_q, (4, 1))
    v = [np.ones((4, model.nv))] if name == "implicit_constraint" else []
    expected = model.evaluate(full, q, *v)
    if case == "quaternion":
        q[1, 3:7] *= 1.1
    else:
        q[1, -1] = np.inf if case == "not finite" else model.standing_q[-1] + 2.0
    found = function(q, *v)
    for result, right in zip(found if isinstance(found, tuple) else (found,), expected, strict=True):
        assert np.isnan(result[1]).all()
        assert np.array_equal(result[[0, 2, 3]].ravel(), right[[0, 2, 3]].ravel())
    if case in DRIVEN_ROCKERS:
        with pytest.raises(ValueError, match="close"):
            model.evaluate(full, [q[1], np.full(model.nq, np.nan)], *[x[:2] for x in v])
    single = function(q[1], *[x[1] for x in v])
    assert all(np.isnan(result).all() for result in (single if isinstance(single, tuple) else (single,)))


def test_a_control_law_in_njit(model):
    """M vdot + h = tau, with functions called from a function, gives back the acceleration."""
    mass, forward, inverse = mass_matrix(model), forward_dynamics(model), inverse_dynamics(model)

    @numba.njit
    def errors(q, v, vdot):
        tau = inverse(q, v, vdot)
        bias = inverse(q, v, np.zeros_like(vdot))
        return np.abs(mass(q) @ vdot + bias - tau).max(), np.abs(forward(q, v, tau) - vdot).max()

    assert max(errors(*state(model))) < 1e-9


def test_eight_threads(model):
    function = forward_dynamics(model)

    @numba.njit(parallel=True)
    def in_threads(q, v, tau):
        vdot = np.empty_like(v)
        for k in numba.prange(len(q)):
            vdot[k] = function(q[k], v[k], tau[k])
        return vdot

    q, v, tau = state(model, (500,))
    before = numba.get_num_threads()
    numba.set_num_threads(min(8, numba.config.NUMBA_NUM_THREADS))
    try:
        for _ in range(5):
            assert np.array_equal(in_threads(q, v, tau), model.forward_dynamics(q, v, tau))
    finally:
        numba.set_num_threads(before)


SCRIPT = """
import numba, numpy as np, ce_gym, ce_gym.numba

model = ce_gym.Model(ce_gym.load_robot("robot/mini_cheetah.yaml"))
dynamics = ce_gym.numba.forward_dynamics(model)

@numba.njit
def inner(q, v, tau):
    return dynamics(q, v, tau)

@numba.njit(cache=True, parallel={parallel})
def outer(q, v, tau):
    total = np.zeros_like(v)
    for k in numba.prange(3):
        total += inner(q, v, k * tau)
    return total

q, v = model.standing_q, np.ones(model.nv)
found, expected = outer(q, v, v), sum(model.forward_dynamics(q, v, k * v) for k in range(3))
print(np.allclose(found, expected, rtol=1e-12), sum(outer.stats.cache_hits.values()), found[5])
"""


@pytest.mark.slow
def test_cached_code_is_used_again_and_never_for_an_edited_robot(tmp_path: Path):
    source = Path(load_robot("mini_cheetah").source)
    shutil.copytree(source.parent, tmp_path / "robot")
    urdf = tmp_path / "robot" / "mini_cheetah.urdf"
    original = urdf.read_text()
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(parallel=True))

    def run() -> list[str]:
        result = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return result.stdout.split()

    first, second = run(), run()
    assert [first[:2], second[:2]] == [["True", "0"], ["True", "1"]]
    assert first[2] == second[2]
    urdf.write_text(original.replace('<mass value="', '<mass value="1', 1))
    edited = run()
    assert edited[:2] == ["True", "0"]
    assert edited[2] != first[2]
    assert run() == ["True", "1", edited[2]]
    urdf.write_text(original)
    assert run() == first
