"""Gyros, accelerometers, foot switches, encoders and currents by closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.model import load_robot

G = 9.81


def program(**terms) -> TaskProgram:
    return make_program(TRIPOD, "velocity", observations=terms)


def read(p: TaskProgram, term: str, **state) -> np.ndarray:
    """What a term reads in a state; what is not given is that of the standing robot at rest, long in its episode."""
    function = p.stages.terms_function({term: p.observation_terms[term]})
    known = {"q": p.model.standing_q, "clock": 9.0} | {
        k if k in p.schema else f"observation_{term}_{k}": x for k, x in state.items()
    }
    values = [known.get(name, np.zeros(function.size1_in(i))) for i, name in enumerate(function.name_in())]
    return np.array(function(*values)).ravel()


@pytest.fixture(scope="module")
def imu() -> TaskProgram:
    return program(accelerometer={"position": [0.3, 0.0, 0.1], "scale": 1.0}, gyro={"scale": 1.0})


def turned(p: TaskProgram, angle: float, axis: int) -> np.ndarray:
    q = np.array(p.model.standing_q)
    q[3:7] = 0.0
    q[3], q[4 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def test_at_rest_it_is_g_upwards_whatever_the_pose(imu):
    np.testing.assert_allclose(read(imu, "accelerometer"), [0, 0, G], atol=1e-12)
    rolled = turned(imu, 0.5, 0)
    np.testing.assert_allclose(read(imu, "accelerometer", q=rolled), [0, G * np.sin(0.5), G * np.cos(0.5)], atol=1e-12)


def test_in_free_fall_it_is_nothing(imu):
    """A body that pitches at no rate and falls, its axes turned: velocities are of the base's axes."""
    q, T = turned(imu, 0.7, 1), imu.control_dt
    before = np.array([0.4, -0.2, 1.0])
    now = before - [0, 0, G * T]
    R = np.array([[np.cos(0.7), 0, np.sin(0.7)], [0, 1, 0], [-np.sin(0.7), 0, np.cos(0.7)]])
    v = np.zeros(imu.model.nv)
    v[3:6] = R.T @ now
    np.testing.assert_allclose(read(imu, "accelerometer", q=q, v=v, velocity=before), 0, atol=1e-10)


def test_on_a_spinning_body_it_is_centripetal(imu):
    """About the vertical at a steady rate: w^2 r towards the axis, by the chord that the velocity moves along."""
    w, T = 2.0, imu.control_dt
    v = np.zeros(imu.model.nv)
    v[2] = w
    spun = turned(imu, 1.0, 2)
    angle = 1.0 - w * T
    before = 0.3 * w * np.array([-np.sin(angle), np.cos(angle), 0.0])
    found = read(imu, "accelerometer", q=spun, v=v, velocity=before)
    chord = 0.3 * w * (2 * np.sin(w * T / 2) / T)  # the mean, which lags by half a step
    np.testing.assert_allclose(found[:2], [-chord * np.cos(w * T / 2), chord * np.sin(w * T / 2)], atol=1e-10)
    assert np.linalg.norm(found[:2]) == pytest.approx(0.3 * w**2, rel=1e-3)
    assert found[2] == pytest.approx(G)
    np.testing.assert_allclose(read(imu, "gyro", v=v), [0, 0, w], atol=1e-12)


def test_the_first_reading_of_an_episode_is_that_of_rest(imu):
    v = np.zeros(imu.model.nv)
    v[3:6] = [1.0, 2.0, 3.0]
    np.testing.assert_allclose(read(imu, "accelerometer", v=v, clock=0.0), [0, 0, G], atol=1e-12)


def test_a_bias_is_drawn_for_an_episode_and_spares_the_critic():
    """In the traced functions: the policy's reading has the state `drift`, the critic's has none."""
    terms = {"accelerometer": {"bias": 0.5}, "gyro": {"bias": 0.1}}
    p = make_program(TRIPOD, "velocity", observations=terms, critic=["base_height"])
    drifts = {name: row.size for name, row in p.schema.items() if row.writer == "drift"}
    assert drifts == {"observation_accelerometer_bias": 3, "observation_gyro_bias": 3}
    call, function = (c := p.stages.evaluate()[0]), c.function
    values = {name: np.zeros(function.size1_in(i)) for i, name in enumerate(call.inputs)} | {"q": p.model.standing_q}
    values |= {"clock": 3.0, "observation_gyro_bias": [1.0, -1.0, 0.5]}
    found = function(*[values[name] for name in call.inputs])[call.outputs.index("observation")]
    policy, critic = np.split(np.array(found).ravel(), [6])
    np.testing.assert_allclose(policy[3:6], 0.25 * 0.1 * np.array([1.0, -1.0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(critic[3:6], 0, atol=1e-12)


def test_switches_close_above_a_threshold():
    p = make_program("mini_cheetah", "velocity", observations={"foot_contact_switches": {"threshold": 20.0}})
    spheres = {contact.name: contact for contact in p.model.robot.contacts}
    feet = [name for name in p.contacts if spheres[name].group == "foot"]
    loads = np.zeros(len(p.contacts))
    for name, load in zip(feet, [0.0, 19.9, 20.1, 300.0], strict=True):
        loads[p.contacts.index(name)] = load
    np.testing.assert_array_equal(read(p, "foot_contact_switches", load=loads), [0, 0, 1, 1])


def test_encoders_tell_joints_by_whole_counts_of_their_rotors():
    """Behind gears: to half a count of the rotor over its ratio, in whole counts."""
    p, counts, ratio = program(joint_encoders={"counts": 64}), 64, 6.0
    q = np.array(p.model.standing_q)
    q[-2:] += [0.123, -0.2871]
    told = read(p, "joint_encoders", q=q) + p.model.standing_q[-2:]
    count = 2 * np.pi / counts / ratio
    np.testing.assert_allclose(told, count * np.round(q[-2:] / count), atol=1e-12)
    assert 1e-3 < np.abs(told - q[-2:]).max() <= count / 2


def test_encoders_tell_joints_through_belts_and_differentials():
    """Where joints were as they are told, rotors of belts, and of Tello's ankles nearly, would be at whole counts."""
    for robot, width in (("mit_humanoid", 0.1), ("tello", 0.1)):
        p = make_program(robot, "velocity", observations={"joint_encoders": {"counts": 256}})
        model, rng = p.model, np.random.default_rng(2)
        n, count = len(model.joint_links), 2 * np.pi / 256
        q = np.array(model.standing_q)
        q[7 : 7 + n] += rng.uniform(-width, width, n)
        told = np.array(q)
        told[7 : 7 + n] = read(p, "joint_encoders", q=q) + model.standing_q[7 : 7 + n]
        rows = [model.spanning_names.index(motor.rotor) for motor in model.robot.motors]
        angles = model.spanning(told, np.zeros(model.nv))[0][-len(model.spanning_names) :][rows]
        np.testing.assert_allclose(angles / count, np.round(angles / count), atol=0.02)
        assert np.abs(told - q).max() > 1e-4


def test_motor_torques_are_what_the_windings_give():
    """Before friction, of limited motors; what joints ask through the transmission, of ideal ones."""
    p = make_program(TRIPOD, "velocity", observations=["motor_torques"], motors="limited")
    assert p.schema["motor_torque"].size == 2
    np.testing.assert_allclose(read(p, "motor_torques", motor_torque=[1.0, -0.25]), [0.5, -0.25])
    model = Model(replace(load_robot(TRIPOD), motors=tuple(replace(m, friction=0.2) for m in p.model.robot.motors)))
    asked = {"target": np.array([3.0, 1.2]), "q": model.standing_q, "v": np.zeros(8), "diverged": 0, "dt": 0.005}
    for motors in ("limited", "ideal"):
        options = StepOptions(control="torque", motors=motors)
        found = step_function(model.mechanism, options, ("motor_torque", "torque"))(**asked)
        np.testing.assert_allclose(found["motor_torque"].full().ravel(), [0.5, -0.2], atol=1e-12)
        assert np.allclose(found["torque"].full().ravel(), asked["target"]) == (motors == "ideal")


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"joint_encoders": {"counts": 0}}, "'joint_encoders': counts=0; expected 1 or more"),
        ({"gyro": {"link": "tail"}}, "'gyro': link='tail'; expected one of"),
        ({"accelerometer": {"position": [1, 2]}}, r"'accelerometer': position=\[1, 2\]; expected three lengths"),
    ],
)
def test_bad_parameters(terms: dict, message: str):
    with pytest.raises(ValueError, match=message):
        program(**terms)
