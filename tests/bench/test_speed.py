"""The parts of the speed benchmark: what is counted, who is compared, and that peers simulate the same robot."""

import numpy as np
import pytest

from ce_gym.compile import Kernel, aligned_zeros, lane_count
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_peak_is_of_multiply_adds_that_are_done(dtype):
    pytest.importorskip("mujoco")
    from ce_gym.bench.speed import competitors

    lanes, chains, links = lane_count(dtype), competitors.CHAINS, competitors.LINKS
    arrays = {name: aligned_zeros((1, n, lanes), dtype) for name, n in (("x", chains), ("factor", 2))}
    arrays["x"][:] = np.random.default_rng(0).uniform(-1e9, 1e9, arrays["x"].shape)
    arrays["factor"][:] = 0.5
    expected = arrays["x"].astype(float)
    for _ in range(links):
        expected = 0.5 * expected + 0.5
    competitors.peak_kernel(dtype)(arrays, lanes, repeats={"times": 1})
    np.testing.assert_allclose(arrays["x"], expected, rtol=1e-6)
    assert competitors.peak(dtype).work == 2 * chains * links * competitors.PEAK_REPEATS * lanes


@pytest.mark.parametrize("name", ["mini_cheetah", "mit_humanoid", "jvrc1"])
def test_pinocchio_has_the_same_dynamics(name):
    pin = pytest.importorskip("pinocchio")
    from ce_gym.bench.peers import pinocchio as pinocchio_peer

    robot, rng = load_robot(name), np.random.default_rng(3)
    model, peer = Model(robot, "armature"), pinocchio_peer.load(robot)
    q, v, tau = model.standing_q.copy(), rng.uniform(-2, 2, model.nv), rng.uniform(-5, 5, model.nv)
    q[7:] += rng.uniform(-0.5, 0.5, len(robot.independent))
    q[3:7] = rng.normal(size=4)
    q[3:7] /= np.linalg.norm(q[3:7])
    expected = model.forward_dynamics(q, v, tau)
    state = peer.positions(q), peer.velocities(v), peer.velocities(tau)
    theirs = np.asarray(pin.aba(peer.model, peer.model.createData(), *state))
    np.testing.assert_allclose(peer.accelerations(theirs), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_mujoco_on_two_threads_is_mujoco_on_one():
    pytest.importorskip("mujoco")
    from ce_gym.bench.peers import stand
    from ce_gym.bench.speed.competitors import mujoco_batch

    robot = stand.bare(load_robot("mini_cheetah"), "foot")
    control = np.repeat(stand.targets(robot, 6, 1, seed=0), 3, axis=1)
    one, two = (mujoco_batch(robot, "armature", 6, n, 0.005).trajectory(control) for n in (1, 2))
    assert one.shape[:2] == (6, 3)
    np.testing.assert_array_equal(one, two)


def computed(kernel: Kernel, states: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Run a kernel on as many states as a vector register holds; return what it computes, shape (size, lanes)."""
    lanes = lane_count("float64")
    arrays = {name: aligned_zeros((1, buffer.size, lanes), "float64") for name, buffer in kernel.buffers.items()}
    for name in ("q", "v", "tau"):
        arrays[name][0] = states[name].T
    kernel(arrays, lanes)
    return {name: array[0] for name, array in arrays.items() if name not in ("q", "v", "tau")}


@pytest.mark.parametrize("name", ["four_bar", "mit_humanoid_leg"])
def test_kernels_compute_forward_dynamics_and_its_derivatives(name: str):
    pytest.importorskip("mujoco")
    from ce_gym.bench.speed import competitors

    robot = load_robot(name)
    model = Model(robot, "armature")
    states = competitors.random_states(model, lane_count("float64"))
    given = [states[key] for key in ("q", "v", "tau")]
    vdot = computed(competitors.dynamics_kernel(robot, "armature", "float64"), states)["vdot"]
    np.testing.assert_allclose(vdot.T, model.forward_dynamics(*given), rtol=1e-9, atol=1e-9)
    slopes = computed(competitors.dynamics_kernel(robot, "armature", "float64", derivatives=True), states)
    for found, expected in zip(slopes.values(), model.forward_dynamics_derivatives(*given), strict=True):
        np.testing.assert_allclose(found.T.ravel(), expected.swapaxes(1, 2).ravel(), rtol=1e-9, atol=1e-9)


def test_mujoco_holds_a_robot_with_passive_joints_by_the_others():
    pytest.importorskip("mujoco")
    from ce_gym.bench.speed.competitors import mujoco_batch, mujoco_steps

    robot = load_robot("cassie")
    batch = mujoco_batch(robot, "coupled", 2, 1, 0.005)
    assert batch.model.nu == len(robot.driven) == len(robot.independent) - 4
    mujoco_steps(batch, robot).run()
