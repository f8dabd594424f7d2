"""Tasks on ground that is not flat, and the curricula: what a robot carries from one episode to the next."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from tripod import TRIPOD

import ce_gym  # noqa: F401 - registers the environments
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.terrain_kinds import BORDER, PLATFORM
from ce_gym.envs.task.terrain_tiles import checked_terrain, make_field

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

VELOCITY = "ce_gym/MiniCheetahVelocity-v0"
KINDS = ("slope", "rough", "stairs")
CURRICULA = {"terrain": "slope", "command_curriculum": 0.3, "episode_length": 40, "max_episode_steps": 40}


def make(n: int = 8, mode: str = "SameStep", **arguments):
    envs = gymnasium.make_vec(VELOCITY, num_envs=n, autoreset_mode=mode, **{"robot": TRIPOD, **arguments}).unwrapped
    envs.reset(seed=0)
    return envs


def zeros(envs) -> np.ndarray:
    return np.zeros(envs.action_space.shape, np.float32)


def ground_under(envs) -> np.ndarray:
    q = envs.state()["q"]
    return make_field(envs.batch.program.task.terrain).at(q[:, 0], q[:, 1])[:, 0]


@pytest.mark.parametrize("kind", ["boxes", "gaps", "stones"])
def test_a_course_is_between_platform_and_rim(kind: str):
    """Heights are those asked for, platform and rim are level, and the share that is land is that of the figures."""
    figures = {"boxes": {"height": 0.2, "side": 0.4}, "gaps": {"land": 0.6}, "stones": {"stone": 0.5}}[kind]
    figures |= {} if kind == "boxes" else {"gap": 0.2, "depth": 0.7}
    field = make_field(checked_terrain({"kind": kind, "levels": 2, "columns": 2, "cell": 0.02, **figures}))
    along = np.linspace(-3.98, 3.98, 399)
    x, y = np.meshgrid(along, along, indexing="ij")
    away, rim = np.maximum(np.abs(x), np.abs(y)), 4 - BORDER
    course = (away > PLATFORM + 0.04) & (away < rim - 0.04)
    assert not field.at(4.0 + x, 4.0 + y)[..., 0].any(), "the lowest level is flat"
    heights = field.at(12.0 + x, 4.0 + y)[..., 0]
    assert np.abs(heights[(away < PLATFORM - 0.04) | (away > rim + 0.04)]).max() < 1e-12
    if kind == "boxes":
        assert 0.15 < heights[course].max() <= 0.2
        assert -0.2 <= heights[course].min() < -0.15
        _, counts = np.unique(np.round(heights[course], 9), return_counts=True)
        assert counts[counts > 100].sum() > 0.6 * course.sum(), "squares are level"
        return
    assert heights.min() == pytest.approx(-0.7, abs=1e-9)
    starts = np.arange(PLATFORM, rim, 0.8)  # gaps are rings about the middle: areas of the stretches of land
    rings = np.sum(np.minimum(starts + 0.6, rim) ** 2 - starts**2) / (rim**2 - PLATFORM**2)
    land = {"stones": (0.5 / 0.7) ** 2, "gaps": rings}[kind]
    assert np.mean(heights[course] > -0.35) == pytest.approx(land, abs=0.04)


def test_a_mixture_is_columns_of_kinds_by_their_shares():
    """Each tile is that of its kind alone, with figures of its own; pyramids and pits by turns within a kind."""
    kinds = {"stairs": {"share": 0.5, "rise": 0.2}, "slope": 0.25, "flat": 0.25}
    mixed = checked_terrain({"kinds": kinds, "levels": 3, "columns": 4, "size": 6.0})
    assert mixed["cell"] == 0.05
    assert checked_terrain(mixed) == mixed
    field, own = make_field(mixed), {"levels": 3, "columns": 2, "size": 6.0}
    stairs = make_field(checked_terrain({"kind": "stairs", "rise": 0.2, **own}))
    slope = make_field(checked_terrain({"kind": "slope", "cell": 0.05, **own}))
    x, y = np.meshgrid(np.linspace(0.1, 17.9, 90), np.linspace(0.2, 5.8, 40), indexing="ij")
    for column, (alone, first) in enumerate([(stairs, 0.0), (stairs, 6.0), (slope, 0.0)]):
        expected = alone.at(x, y + first)[..., 0]
        np.testing.assert_allclose(field.at(x, y + 6 * column)[..., 0], expected, atol=1e-9)
    assert not field.at(x, y + 18.2)[:, :-5, 0].any()
    with pytest.raises(ValueError, match=r"terrain\['columns'\]=2; expected more, for a share of 0.1"):
        make_field(checked_terrain({"kinds": {"stairs": 0.1, "rough": 9}, "columns": 2}))


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_is_flat_first_and_as_asked_last(kind: str):
    terrain = checked_terrain({"kind": kind, "levels": 3, "columns": 2, "size": 8.0})
    field = make_field(terrain)
    along = np.linspace(-4, 4, 201)
    first, last = (field.at((level + 0.5) * 8 + along, 4.0)[:, 0] for level in (0, 2))
    assert np.abs(first[10:-10]).max() < 1e-12
    run = 4 - BORDER - PLATFORM
    if kind == "slope":
        assert last.max() == pytest.approx(np.tan(terrain["angle"]) * run, rel=1e-3)
        assert field.at(20.0 + 2.0, 4.0)[1] == pytest.approx(-np.tan(terrain["angle"]), rel=1e-6)
        pit = field.at(20.0, 12.0)[0]
        assert pit == pytest.approx(-last.max(), rel=1e-6)
    elif kind == "stairs":
        assert last.max() == pytest.approx(terrain["rise"] * np.ceil(run / terrain["tread"]), rel=1e-6)
        steps = np.diff(np.unique(np.round(field.at(20.0 + np.arange(1.2, 3.4, 0.01), 4.0)[:, 0], 6)))
        assert steps.max() <= terrain["rise"]
    else:
        assert 0.5 * terrain["amplitude"] < np.abs(last).max() <= terrain["amplitude"]
    if kind != "rough":
        x = np.linspace(0, 24, 97)
        assert np.abs(field.at(x, 8.0)[:, 0]).max() < 1e-9, "columns meet at 0"
        assert np.abs(field.at(np.array([8.0, 16.0]), 4.0)[:, 0]).max() < 1e-9, "levels meet at 0"


def test_flat_ground_costs_nothing():
    """Nothing of a field is there, and the counts are no higher; whoever makes it cheaper may lower them.

    Before there was terrain `evaluate` took 799 and `reset` 734. Since then 161 came for the end of an episode (length,
    failures, time limit, sums, masks of NaN), which another function of 211 or the host had to do; and 134 for how an
    episode begins, 126 of them for the springs' forces on the contacts, and 3 for the count of sub-steps made in parts.
    None of it depends on the terrain.
    """
    program = make_program("mini_cheetah", "velocity")
    counted = {name: program.function(name).n_instructions() for name in ("act", "evaluate", "reset")}
    assert counted["act"] <= 85
    assert counted["evaluate"] <= 960
    assert counted["reset"] <= 871
    for kernel in (program.step_program(), program.reset_program()):
        assert not [buffer for buffer in kernel.buffers if buffer.kind == "table"]
    assert len(program.reset_program().calls) == 1
    assert not {"level", "walked", "grown", "tracked"} & set(program.state_sizes)
    assert make_program("mini_cheetah", "velocity", terrain="flat", command_curriculum=1.0).task == program.task


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "dtype"), [*((kind, "float64") for kind in KINDS), ("slope", "float32")])
def test_episodes_begin_on_the_ground_in_the_middle_of_a_tile(kind: str, dtype: str):
    envs = make(96, terrain={"kind": kind, "curriculum": False}, dtype=dtype)
    flat = make(96, dtype=dtype)
    terrain, q = envs.batch.program.task.terrain, envs.state()["q"]
    level, size = envs.batch.rows("level")[:, 0], terrain["size"]
    assert set(level) == set(range(terrain["levels"]))
    assert np.abs(q[:, 0] - (level + 0.5) * size).max() <= PLATFORM / 2 + 1e-5
    column = q[:, 1] / size - 0.5
    assert set(np.round(column)) == set(range(terrain["columns"]))
    assert np.abs(column - np.round(column)).max() * size <= PLATFORM / 2 + 1e-5
    above = q[:, 2] - ground_under(envs)
    standing = envs.model.standing_q[2]
    slack = 2 * terrain.get("amplitude", 0.0) + 0.04  # of the joints' noise, where one foot is the lowest
    assert np.abs(above - standing).max() < slack
    for _ in range(10):
        *_, terminated, truncated, _ = envs.step(zeros(envs))
        flat.step(zeros(flat))
        assert not terminated.any()
        assert not truncated.any()
    # No robot has been dropped from high up or thrown out of the ground.
    assert np.abs(envs.state()["v"][:, 3:6]).max() < 2 * np.abs(flat.state()["v"][:, 3:6]).max() + 0.2


def test_heights_are_above_the_ground():
    weights = {"base_height": -10.0, "alive": 20.0}
    envs = make(64, terrain={"kind": "slope", "curriculum": False}, rewards=weights)
    *_, infos = envs.step(zeros(envs))
    q, under = envs.state()["q"], ground_under(envs)
    assert np.abs(under).max() > 0.5
    expected = -10.0 * (q[:, 2] - under - envs.model.standing_q[2]) ** 2 * envs.dt
    np.testing.assert_allclose(infos["reward_terms"]["base_height"], expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("where", ["pyramid", "pit"])
def test_a_fallen_robot_has_fallen_wherever_it_is(where: str):
    """A belly on the ground ends the episode on top of a pyramid and at the bottom of a pit, standing does neither."""
    envs = make(2, terrain={"kind": "stairs", "curriculum": False}, contacts=[], terminations=["torso_contact"])
    q, v = envs.batch.rows("q"), envs.batch.rows("v")
    size = envs.batch.program.task.terrain["size"]
    q[:, :2] = [5.5 * size, (0.5 if where == "pyramid" else 1.5) * size]
    under = make_field(envs.batch.program.task.terrain).at(q[0, 0], q[0, 1])[0]
    assert abs(under) > 0.5
    q[:, 2], q[:, 3:7] = under + envs.model.standing_q[2], [1.0, 0.0, 0.0, 0.0]
    q[:, 7:] = envs.model.standing_q[7:]
    q[0, 2] = under + 0.02
    envs.batch.write("q", q)
    envs.batch.write("v", 0 * v)
    _, _, terminated, _, _ = envs.step(zeros(envs))
    assert terminated.tolist() == [True, False]


@pytest.mark.slow
def test_feet_on_slopes_know_that_they_touch():
    """What the task sees of the contacts is what the physics makes of them, half way up a slope too."""
    terrain = {"kind": "slope", "angle": 0.3, "curriculum": False}
    envs = make(64, robot="mini_cheetah", terrain=terrain, observations=["feet_in_contact"])
    q, terrain = envs.batch.rows("q"), envs.batch.program.task.terrain
    field = make_field(terrain)
    q[:, 0] += 2.0 * np.sign(np.arange(64) % 2 - 0.5)
    q[:, 2] = envs.model.standing_q[2] + field.at(q[:, 0], q[:, 1])[:, 0] + 0.1
    envs.batch.write("q", q)
    for _ in range(75):
        seen, _, terminated, _, _ = envs.step(zeros(envs))
    loaded = envs.batch.rows("load")[:, [n in FEET for n in envs.contact_names]] > 0
    assert loaded.mean() > 0.2
    assert (seen[~terminated] == loaded[~terminated]).mean() > 0.97


FEET = ("HR_foot", "HL_foot", "FR_foot", "FL_foot")


def judged(envs, walked, asked, clock, level=2.0, command=0.0) -> np.ndarray:
    """Levels of the episodes that follow such ones."""
    n = envs.num_envs
    envs.batch.write("level", np.full((n, 1), level))
    envs.batch.write("walked", np.column_stack([np.full(n, walked), np.full(n, asked)]))
    envs.batch.write("clock", np.full((n, 1), clock))
    envs.batch.write("command", np.tile([command, 0.0, 0.0], (n, 1)))
    envs.reset()
    return envs.batch.rows("level")[:, 0]


def test_robots_go_up_and_down():
    envs = make(64, terrain="slope")
    top = envs.batch.program.task.terrain["levels"] - 1
    length = envs.batch.program.task.episode_length
    assert (envs.batch.rows("level") == 0).all(), "everyone begins at the bottom"
    assert (judged(envs, walked=4.1, asked=12.0, clock=length) == 3).all()
    assert (judged(envs, walked=3.9, asked=6.0, clock=length) == 2).all(), "half of what it was asked"
    assert (judged(envs, walked=3.9, asked=9.0, clock=length) == 1).all()
    assert (judged(envs, walked=0.4, asked=0.5, clock=50, command=0.5) == 1).all(), "fallen after a second"
    assert (judged(envs, walked=0.0, asked=0.0, clock=50, command=0.0) == 2).all(), "asked to stand"
    assert (judged(envs, walked=-1.0, asked=9.0, clock=length, level=0) == 0).all()
    anywhere = judged(envs, walked=5.0, asked=9.0, clock=length, level=top)
    assert set(anywhere) == set(range(top + 1)), "who has passed the last goes anywhere"


def test_walking_is_counted_along_the_command():
    envs = make(16, terrain="slope", standing_fraction=0.0)
    command, total = envs.state()["command"], np.zeros((16, 2))
    for _ in range(5):
        envs.step(zeros(envs))
        asked = np.linalg.norm(command[:, :2], axis=1)
        along = (envs.state()["v"][:, 3:5] * command[:, :2]).sum(1) / asked
        total += envs.dt * np.column_stack([along, asked])
    np.testing.assert_allclose(envs.batch.rows("walked"), total, rtol=1e-9, atol=1e-12)


def test_commands_widen_with_tracking():
    envs = make(256, command_curriculum=0.35, standing_fraction=0.0, episode_length=100)
    highest = np.array([1.0, 0.5, 1.0])

    def share_after(mean: float, times: int = 1) -> float:
        for _ in range(times):
            envs.batch.write("tracked", np.full((256, 1), 100 * mean))
            envs.reset()
        shares = np.abs(envs.state()["command"]).max(0) / highest
        assert np.ptp(shares) < 0.05 * shares.max()
        return float(shares.max())

    assert share_after(0.6) == pytest.approx(0.35, rel=0.05)
    assert share_after(0.9) == pytest.approx(0.45, rel=0.05)
    assert share_after(0.9, 3) == pytest.approx(0.75, rel=0.05)
    assert share_after(0.3) == pytest.approx(0.65, rel=0.05)
    assert share_after(0.9, 9) == pytest.approx(1.0, rel=0.05)
    assert share_after(0.3) == pytest.approx(0.95, rel=0.1), "the top has been reached in seven steps of a tenth"
    assert share_after(0.3, 9) == pytest.approx(0.35, rel=0.05)
    envs.step(zeros(envs))
    error = np.sum((envs.state()["command"][:, :2] - envs.state()["v"][:, 3:5]) ** 2, axis=1)
    np.testing.assert_allclose(envs.batch.rows("tracked")[:, 0], np.exp(-error / 0.25), rtol=1e-9)


def test_progress_is_in_infos_and_metrics():
    envs = make(4, **CURRICULA)
    _, infos = envs.reset(seed=3)
    assert infos["terrain_level"].tolist() == [0.0] * 4
    envs.batch.write("level", [[0.0], [1.0], [2.0], [3.0]])
    for _ in range(40):
        *_, infos = envs.step(zeros(envs))
    ended = infos["_episode_terms"]
    assert ended.any()
    expected = np.array([0.0, 1.0, 2.0, 3.0])[ended]
    np.testing.assert_allclose(infos["episode_terms"]["metrics/terrain_level"][ended], expected)
    assert infos["terrain_level"].shape == infos["times_grown"].shape == (4,)
    single = gymnasium.make(VELOCITY, robot=TRIPOD, terrain="slope")
    _, info = single.reset(seed=0)
    assert info["terrain_level"] == 0.0


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_the_same_seeds_whatever_the_batch(mode: str):
    """Through curricula and resets, bit for bit; and seeding again starts them again."""
    actions = np.random.default_rng(0).uniform(-1, 1, (130, 64, 2)).astype(np.float32)

    def rollout(n: int, threads: int) -> tuple[list, np.ndarray]:
        envs = make(n, mode, num_threads=threads, **CURRICULA)
        histories = []
        for _ in range(2):
            observation, _ = envs.reset(seed=10)
            envs.batch.write("level", 2 + np.arange(64)[:n, None] % 3)
            history = [observation]
            for action in actions[:, :n]:
                observation, reward, *_, infos = envs.step(action)
                history += [observation, reward, infos["terrain_level"], infos["times_grown"]]
            histories.append(history)
        for a, b in zip(*histories, strict=True):
            np.testing.assert_array_equal(a, b)
        return histories[0], envs.batch.rows("level")

    whole, levels = rollout(64, 2)
    assert len(set(levels[:, 0])) > 2
    for n, threads in ((1, 1), (7, 2), (64, 1)):
        for ours, theirs in zip(rollout(n, threads)[0], whole, strict=True):
            np.testing.assert_array_equal(ours, theirs[:n])


def test_a_lane_that_is_reset_one_step_later_is_judged_as_one_that_is_not():
    """The step that next-step mode ignores does not count in a curriculum."""
    actions = np.random.default_rng(1).uniform(-0.3, 0.3, (200, 16, 2)).astype(np.float32)

    def judgements(mode: str) -> list[list[tuple[float, float]]]:
        envs, index, over = make(16, mode, **CURRICULA), np.zeros(16, int), np.zeros(16, bool)
        envs.batch.write("level", np.full((16, 1), 3.0))
        found: list[list[tuple[float, float]]] = [[] for _ in range(16)]
        for _ in range(200):
            ignored = over & (mode == "NextStep")
            *_, terminated, truncated, infos = envs.step(actions[index, np.arange(16)])
            over = terminated | truncated
            for i in np.flatnonzero(ignored if mode == "NextStep" else over):
                found[i].append((infos["terrain_level"][i], infos["times_grown"][i]))
            index += ~ignored
        return found

    same, later = judgements("SameStep"), judgements("NextStep")
    for ours, theirs in zip(same, later, strict=True):
        count = min(len(ours), len(theirs))
        assert count >= 3
        assert ours[:count] == theirs[:count]
    everything = {judgement for lane in same for judgement in lane}
    assert len({level for level, _ in everything}) > 1
    assert len({grown for _, grown in everything}) > 1


def test_specs_survive_json():
    terrain = {"kind": "stairs", "rise": 0.08, "levels": 4}
    env = gymnasium.make(VELOCITY, robot=TRIPOD, terrain=terrain, command_curriculum=0.5)
    spec = EnvSpec.from_json(env.spec.to_json())
    again = gymnasium.make(spec)
    assert again.unwrapped.batch.program.task == env.unwrapped.batch.program.task
    observation, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again.reset(seed=1)[0], observation)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"terrain": "sea"}, "terrain='sea'; expected 'flat', 'slope', 'rough', 'stairs', .*, or a mapping"),
        ({"terrain": {"kinds": {}}}, r"terrain\['kinds'\]=\{\}; expected shares by kind among flat, slope"),
        ({"terrain": {"kinds": {"sea": 1}}}, r"terrain\['kinds'\]=\{'sea': 1\}; expected shares by kind"),
        ({"terrain": {"kinds": {"rough": 0}}}, r"\['kinds'\]\['rough'\]\['share'\]=0; expected a number above 0"),
        ({"terrain": {"kinds": {"rough": {"rise": 1}}}}, r"\['rough'\]\['rise'\]=1; expected one of share, amplitude"),
        ({"terrain": {"kind": "stones", "stone": 0.0}}, r"terrain\['stone'\]=0.0; expected a length .* at least 0.1"),
        ({"terrain": 3}, "terrain=3; expected"),
        ({"terrain": {"kind": "slope", "rise": 0.1}}, r"terrain\['rise'\]=0.1; expected one of .*angle for 'slope'"),
        ({"terrain": {"kind": "flat", "size": 3.0}}, r"terrain\['size'\]=3.0; expected no argument for 'flat'"),
        ({"terrain": {"kind": "rough", "amplitude": -1.0}}, r"terrain\['amplitude'\]=-1.0; expected a length"),
        ({"terrain": {"kind": "rough", "levels": 1}}, r"terrain\['levels'\]=1; expected a whole number, at least 2"),
        ({"terrain": {"kind": "rough", "size": 2}}, r"terrain\['size'\]=2; expected a length in metres, at least"),
        ({"terrain": {"kind": "slope", "angle": 2.0}}, r"terrain\['angle'\]=2.0; expected an angle"),
        ({"terrain": {"kind": "slope", "curriculum": 1}}, r"terrain\['curriculum'\]=1; expected true or false"),
        ({"terrain": {"kind": "slope", "size": 8000.0}}, "terrain has .* heights; expected at most"),
        ({"command_curriculum": 0}, "command_curriculum=0; expected a positive number, at most 1"),
        ({"command_curriculum": 1.5}, "command_curriculum=1.5; expected a positive number, at most 1"),
    ],
)
def test_bad_arguments(arguments: dict, message: str):
    with pytest.raises(ValueError, match=message) as caught:
        make(2, **arguments)
    assert "\n" not in str(caught.value)
