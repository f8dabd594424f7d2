"""`Simulator(device=...)`: the emitted CUDA source, run by the processor, computes the same numbers."""

import numpy as np
import pytest
import torch
from tripod import TRIPOD

import ce_gym
from ce_gym.compile.cuda.host import host_compiler
from ce_gym.sim.devices import Cpu, Emulated, device_named, to_numpy

N = 20
DTYPES = pytest.mark.parametrize("dtype", ["float64", "float32"])
needs_host_compiler = pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler to run emitted CUDA C with")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")


def stepped(model, dtype, device, **options):
    """State after a sub-step from random states about the standing pose, by name, rows of robots."""
    rng = np.random.default_rng(3)
    sim = ce_gym.Simulator(model, N, dtype=dtype, device=device, **options)
    q = np.tile(model.standing_q, (N, 1))
    if model.robot.floating:
        q[:, 2] += rng.uniform(-0.005, 0.02, N)
    sim.set_state(q, 0.5 * rng.normal(size=(N, model.nv)))
    joints = len(model.joint_links)
    sim.step(model.standing_q[-joints:] + 0.2 * rng.normal(size=(N, joints)))
    return {name: to_numpy(rows).reshape(N, -1) for name, rows in (("q", sim.q), ("v", sim.v))}


def assert_same(one, other):
    for name in one:
        np.testing.assert_array_equal(other[name], one[name], err_msg=name)
    assert np.abs(one["v"]).max() > 0.1


@needs_host_compiler
@pytest.mark.parametrize(
    ("robot", "dtype"),
    [(TRIPOD, "float32"), ("mini_cheetah", "float32")]
    + [(name, "float64") for name in (TRIPOD, "six_bar", "mit_humanoid_leg")],
)
def test_the_same_numbers(robot, dtype):
    model = ce_gym.Model(robot)
    assert_same(*(stepped(model, dtype, device) for device in (Cpu(joint_space=False), Emulated())))


@needs_host_compiler
def test_everything_of_a_simulator():
    """Terrain, parameters, masks, readings: the same through tensors as through arrays, step after step."""
    model = ce_gym.Model(TRIPOD)
    heights = np.random.default_rng(0).uniform(0, 0.03, (40, 50))
    options = {
        "terrain": ce_gym.Terrain(heights, 0.1, (-2.0, -2.5)),
        "parameters": ("friction", "stiffness", "kp"),
        "outputs": ("torque", "contact_forces", "energy", "power"),
        "contacts": "foot",
    }
    rng = np.random.default_rng(1)
    sims = [ce_gym.Simulator(model, N, device=device, **options) for device in (Cpu(joint_space=False), Emulated())]
    mask, friction = rng.random(N) > 0.5, rng.uniform(0.2, 1.0, (N, 1))
    targets = model.standing_q[7:] + rng.uniform(-0.3, 0.3, (6, N, 2))
    for sim, kind in zip(sims, (np.asarray, torch.from_numpy), strict=True):
        sim.set_parameter("friction", kind(friction), kind(mask))
        for target in targets[:3]:
            sim.step(kind(target), n_substeps=2)
        sim.reset(kind(mask))
        for target in targets[3:]:
            sim.step(kind(target), n_substeps=2)
    cpu, gpu = sims
    assert isinstance(gpu.q, torch.Tensor)
    for name in ("q", "v", "torque", "contact_forces", "energy", "power"):
        one, other = getattr(cpu, name), getattr(gpu, name)
        assert other.shape == one.shape
        np.testing.assert_array_equal(other.numpy(), one, err_msg=name)
    assert gpu.n_diverged == cpu.n_diverged == 0
    before = gpu.q
    gpu.step(targets[0])
    assert not torch.equal(before, gpu.q), "what was read must be a copy"


@needs_host_compiler
def test_a_method_of_several_steps_agrees():
    model = ce_gym.Model(TRIPOD)
    options = {"method": "extrapolated", "contacts": "foot", "outputs": ("error",)}
    assert_same(*(stepped(model, "float64", device, **options) for device in (Cpu(joint_space=False), Emulated())))


@needs_host_compiler
def test_steps_in_parts_agree():
    """Robots of one tile need one part, two and many; a thread of a GPU has one robot."""
    model, found = ce_gym.Model("planar_leg_linkage"), []
    v = np.linspace(0.0, 400.0, N)[:, None] * np.ones(model.nv)
    for device in (Cpu(joint_space=False), Emulated()):
        sim = ce_gym.Simulator(model, N, device=device)
        sim.set_state(np.tile(model.standing_q, (N, 1)), v)
        sim.step(model.standing_q, 3)
        found.append({name: to_numpy(getattr(sim, name)) for name in ("q", "v", "torque", "n_retried")})
    assert found[0]["n_retried"] > N
    assert_same(*found)


@needs_host_compiler
def test_a_diverged_robot_is_frozen_and_flagged():
    model = ce_gym.Model(TRIPOD)
    for device in (Cpu(joint_space=False), Emulated()):
        sim = ce_gym.Simulator(model, 4, device=device)
        v = np.zeros((4, model.nv))
        v[2, 0] = 1e6
        sim.set_state(sim.q, v)
        sim.step(model.standing_q[7:])
        assert list(map(bool, sim.diverged)) == [False, False, True, False]
        assert sim.n_diverged == 1
        sim.reset(np.array([False, False, True, False]))
        assert (sim.n_diverged, bool(sim.diverged.any())) == (1, False)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "CPU"])
def test_unknown_devices_are_refused(name):
    with pytest.raises(ValueError, match=r"device='.*'; expected 'cpu', 'cuda' or 'cuda:N'"):
        device_named(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_line_says_so():
    with pytest.raises(ValueError, match=r"^device='cuda:0': torch .* sees no NVIDIA GPU; expected device='cpu'$"):
        ce_gym.Simulator(ce_gym.Model("six_bar"), device="cuda")


@needs_gpu
@DTYPES
def test_a_gpu_gives_the_same_numbers(dtype):
    model = ce_gym.Model("mini_cheetah")
    assert_same(*(stepped(model, dtype, device) for device in (Cpu(joint_space=False), "cuda")))
