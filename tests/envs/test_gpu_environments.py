"""Vector environments with `device="cuda"`: one launch a step, computed here by the processor from its source."""

import gymnasium
import numpy as np
import pytest
import torch
from tripod import TRIPOD

from ce_gym.compile.cuda import CudaUnavailable, nvrtc
from ce_gym.compile.cuda.host import host_compiler
from ce_gym.compile.cuda.source import emit_source
from ce_gym.envs.runtime.batch import programs
from ce_gym.envs.runtime.setup import make_program
from ce_gym.sim.devices import Cpu, Emulated

ID = "ce_gym/MiniCheetahVelocity-v0"
N, STEPS = 21, 12
needs_host_compiler = pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler to run emitted CUDA C with")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")


def make(device, robot=TRIPOD, **options):
    return gymnasium.make_vec(ID, num_envs=N, robot=robot, autoreset_mode="SameStep", device=device, **options)


def numbers(value):
    return value.cpu().numpy() if isinstance(value, torch.Tensor) else value


def run_both(device, steps=STEPS, **options):
    """Step both kinds with the same seeds and actions: all that they return is the same, bit for bit, or at least
    equal (zeros may differ in sign). Returns them and who ended."""
    pair = make(Cpu(joint_space=False), **options), make(device, **options)
    rng, ended = np.random.default_rng(0), 0
    first = [envs.reset(seed=5)[0] for envs in pair]
    for envs in pair:
        envs.unwrapped.elapsed_steps = np.arange(N) % 7
    compare(first)
    for _ in range(steps):
        action = rng.uniform(-1.2, 1.2, (N, pair[0].single_action_space.shape[0])).astype(np.float32)
        (obs, *rest, infos), (gpu_obs, *gpu_rest, gpu_infos) = (
            envs.step(kind(action)) for envs, kind in zip(pair, (np.asarray, torch.from_numpy), strict=True)
        )
        compare([obs, gpu_obs])
        reward, terminated, truncated = map(numbers, gpu_rest)
        np.testing.assert_array_equal(reward, rest[0])
        np.testing.assert_array_equal(terminated, rest[1])
        np.testing.assert_array_equal(truncated, rest[2])
        for name, values in infos["reward_terms"].items():
            np.testing.assert_array_equal(numbers(gpu_infos["reward_terms"][name]), values, err_msg=name)
        for name in {"terrain_level", "times_grown"} & infos.keys():
            np.testing.assert_array_equal(numbers(gpu_infos[name]), infos[name], err_msg=name)
        done = terminated | truncated
        np.testing.assert_array_equal(numbers(gpu_infos["_final_obs"]), done)
        if done.any():
            compare([infos["final_obs"], gpu_infos["final_obs"]], done)
            for name, values in infos["episode_terms"].items():
                ours = numbers(gpu_infos["episode_terms"][name])  # sums divided by steps, here in the tensors' type
                np.testing.assert_allclose(ours, values, rtol=2e-7, err_msg=name)
        ended += int(done.sum())
    cpu, gpu = (envs.unwrapped for envs in pair)
    np.testing.assert_array_equal(numbers(gpu.elapsed_steps), cpu.elapsed_steps)
    for name in cpu.batch.program.state_sizes:
        np.testing.assert_array_equal(numbers(gpu.batch.rows(name)), cpu.batch.rows(name), err_msg=name)
    return cpu, gpu, ended


def compare(observations, mask=slice(None)):
    one, other = observations
    if isinstance(one, dict):
        for key in one:
            compare([one[key], other[key]], mask)
        return
    np.testing.assert_array_equal(numbers(other)[mask], one[mask])


@needs_host_compiler
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_streams_and_results_are_those_of_the_processor(dtype):
    _, gpu, ended = run_both(Emulated(), max_episode_steps=7, dtype=dtype)
    assert ended > N
    assert gpu.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP


@needs_host_compiler
def test_every_option_of_a_task():
    options = {
        "obs_mode": "dict",
        "critic": ["contact_forces", "base_height"],
        "contact_forces": True,
        "noise": {"joint_positions": 0.02},
        "history": 2,
        "latency": (0, 2),
        "randomise": {"friction": (0.5, 1.2)},
        "push_period": 0.1,
        "push_speed": 0.3,
        "command_period": 0.12,
    }
    cpu, gpu, ended = run_both(Emulated(), steps=8, max_episode_steps=7, **options)
    assert ended
    np.testing.assert_array_equal(gpu.state()["contact_forces"].shape, cpu.state()["contact_forces"].shape)


@needs_host_compiler
def test_on_a_field_with_levels():
    rough = {"kind": "rough", "levels": 3, "columns": 2}
    cpu, _, ended = run_both(Emulated(), steps=9, max_episode_steps=7, terrain=rough)
    assert ended
    assert "level" in cpu.batch.program.state_sizes


@needs_host_compiler
def test_only_some_are_reset():
    envs = make(Emulated())
    before, _ = envs.reset(seed=0)
    mask = np.arange(N) % 3 == 0
    after, _ = envs.reset(options={"reset_mask": mask})
    same = (before == after).all(1).numpy()
    np.testing.assert_array_equal(same, ~mask)
    with pytest.raises(ValueError, match=r"reset_mask=.*expected a bool array of shape"):
        envs.reset(options={"reset_mask": mask[:3]})


@needs_host_compiler
def test_observations_are_left_alone_and_nan_actions_harmless():
    envs = make(Emulated())
    first, _ = envs.reset(seed=0)
    kept = first.clone()
    action = torch.full((N, 2), torch.nan)
    second, reward, *_ = envs.step(action)
    assert torch.equal(first, kept)
    assert bool(torch.isfinite(second).all() and torch.isfinite(reward).all())
    with pytest.raises(ValueError, match=r"action has shape \(3, 2\); expected \(21, 2\)"):
        envs.step(action[:3])


def test_what_a_gpu_does_not_do_is_refused():
    with pytest.raises(ValueError, match="autoreset_mode='NextStep'; expected one of 'SameStep' on device"):
        gymnasium.make_vec(ID, num_envs=2, robot=TRIPOD, device=Emulated(), autoreset_mode="NextStep")
    with pytest.raises(ValueError, match="render_mode='rgb_array'; expected None"):
        gymnasium.make_vec(ID, num_envs=2, robot=TRIPOD, device=Emulated(), render_mode="rgb_array")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_line_says_so():
    with pytest.raises(ValueError, match=r"^device='cuda:0': torch .* sees no NVIDIA GPU; expected device='cpu'$"):
        make("cuda")


@pytest.mark.slow
def test_a_whole_environment_compiles_for_a_gpu():
    try:
        nvrtc.compiler_version()
    except CudaUnavailable as problem:
        pytest.skip(f"not compiled for a GPU: {problem}")
    source = emit_source(programs(make_program("mini_cheetah", "velocity"), Emulated()), "float32")
    _, usage = nvrtc.compile_cubin(source.text, "sm_90")
    assert 128 < usage.registers <= 255
    assert usage.spill_loads < 8000


@needs_host_compiler
def test_one_limb_per_thread_steps_like_the_processor():
    _, _, ended = run_both(Emulated(), robot="mini_cheetah", max_episode_steps=7)
    assert ended > N


@needs_gpu
def test_a_gpu_steps_like_the_processor():
    _, _, ended = run_both("cuda", max_episode_steps=7)
    assert ended > N


@needs_host_compiler
def test_learners_are_served_from_a_gpu():
    """rsl_rl gets the tensors themselves, Stable-Baselines3 copies on the host."""
    adapters = [pytest.importorskip(f"ce_gym.adapters.{name}") for name in ("rsl_rl", "sb3")]
    theirs, ours = (make(Emulated(), max_episode_steps=3) for _ in adapters)
    wrapped = adapters[0].RslRlVecEnv(theirs, seed=1)
    other = adapters[1].SB3VecEnv(ours)
    other.seed(1)
    np.testing.assert_array_equal(wrapped.get_observations()["policy"].numpy(), other.reset())
    action, done = np.full((N, 2), 0.2, np.float32), np.zeros(N)
    for _ in range(3):
        obs, reward, dones, extras = wrapped.step(torch.from_numpy(action))
        rows, rewards, done, infos = other.step(action)
        assert isinstance(rows, np.ndarray)
        np.testing.assert_array_equal(obs["policy"].numpy(), rows)
        np.testing.assert_array_equal(reward.numpy(), rewards)
        np.testing.assert_array_equal(dones.numpy(), done)
    assert done.all()
    assert extras["time_outs"].all()
    assert extras["log"]["/episode/length"] == 3.0
    assert infos[0]["episode"]["l"] == 3
    assert infos[0]["terminal_observation"].shape == rows[0].shape
    wrapped.episode_length_buf = torch.full((N,), 2)
    assert wrapped.step(torch.from_numpy(action))[2].all()
