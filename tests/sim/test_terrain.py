"""Ground that is not flat: the surface, its look-up in kernels, slopes, rolling, standing, bad arguments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, Terrain
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot
from ce_gym.sim.substeps import substeps

G = 9.81
ROBOT = Model(TRIPOD)
NOTHING = np.zeros(0)


def rigid(spheres, mass: float, inertia, **material) -> Robot:
    """One free body with contact spheres (x, y, z, radius) and the world's usual gravity."""
    body = Body("body", "link", None, Placement(), Joint("free"), Inertial(mass, (0.0, 0.0, 0.0), np.diag(inertia)))
    contacts = tuple(ContactSphere(f"c{i}", "body", tuple(s[:3]), s[3]) for i, s in enumerate(spheres))
    return Robot("body", (body,), contacts=contacts, material=ContactMaterial(5e4, 500.0, **material))


def block(mu: float, radius: float = 0.0) -> Robot:
    corners = [(x, y, -0.05 + radius, radius) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    return rigid(corners, 5.0, (0.02, 0.02, 0.03), friction=mu, slip_speed=1e-3, bristle=5e4)


def ball(radius: float, mu: float) -> Robot:
    return rigid([(0.0, 0.0, 0.0, radius)], 2.0, (0.01, 0.01, 0.01), friction=mu, slip_speed=1e-2)


def tilted(angle: float, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation that takes the horizontal plane to the slope, and its quaternion."""
    axis = np.array([np.sin(heading), -np.cos(heading), 0.0])
    x, y, _ = axis
    K = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return R, np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


# The surface


def test_slope_and_flat_are_planes_without_end():
    x, y = np.random.default_rng(0).uniform(-80, 80, (2, 50))
    np.testing.assert_array_equal(Terrain.flat().at(x, y), np.zeros((50, 3)))
    sx, sy = np.tan(0.3) * np.cos(0.7), np.tan(0.3) * np.sin(0.7)
    expected = np.stack([sx * x + sy * y, np.full(50, sx), np.full(50, sy)], -1)
    np.testing.assert_allclose(Terrain.slope(0.3, 0.7).at(x, y), expected, atol=1e-11)


def test_slopes_are_those_of_the_heights():
    terrain, h = Terrain.rough(3, 0.1, cell=0.25, size=4.0), 1e-6
    x, y = np.random.default_rng(1).uniform(-3, 3, (2, 400))
    found = terrain.at(x, y)
    along_x = (terrain.at(x + h, y) - terrain.at(x - h, y))[:, 0] / (2 * h)
    along_y = (terrain.at(x, y + h) - terrain.at(x, y - h))[:, 0] / (2 * h)
    np.testing.assert_allclose(found[:, 1:], np.stack([along_x, along_y], -1), atol=1e-7)


def test_rough_ground_keeps_to_its_amplitude_and_ends_level():
    terrain = Terrain.rough(0, 0.05, cell=0.1, size=2.0)
    x, y = np.meshgrid(*[np.linspace(-1.5, 1.5, 301)] * 2)
    assert 0.02 < np.abs(terrain.at(x, y)[..., 0]).max() <= 0.05
    outside = terrain.at([-30.0, 5.0, 1.2], [-7.0, 9.0, -1.3])
    np.testing.assert_allclose(outside[:, 1:], 0, atol=1e-12)
    np.testing.assert_array_equal(terrain.heights, Terrain.rough(0, 0.05, cell=0.1, size=2.0).heights)
    assert not np.array_equal(terrain.heights, Terrain.rough(1, 0.05, cell=0.1, size=2.0).heights)


def test_stairs_have_their_steps_where_they_should():
    stairs = Terrain.stairs(rise=0.12, tread=0.3, count=4, start=0.5, cell=0.02)
    middles = 0.5 + 0.3 * np.arange(-1, 6) + 0.15
    found = stairs.at(middles, 1.7)
    np.testing.assert_allclose(found[:, 0], 0.12 * np.array([0, 1, 2, 3, 4, 4, 4]), atol=1e-12)
    np.testing.assert_allclose(found[:, 1:], 0, atol=1e-12)
    edges = stairs.at(0.5 + 0.3 * np.arange(4), -2.0)
    np.testing.assert_allclose(edges[:, 0], 0.12 * (np.arange(4) + 0.5), atol=1e-9)


def test_a_function_is_sampled_where_it_should_be():
    terrain = Terrain.from_function(lambda x, y: 0.3 * x - 0.2 * y + 0.05 * x * y, 0.1, 2.0, centre=(3.0, -1.0))
    x, y = np.random.default_rng(2).uniform(-0.9, 0.9, (2, 30)) + [[3.0], [-1.0]]
    np.testing.assert_allclose(terrain.at(x, y)[:, 0], 0.3 * x - 0.2 * y + 0.05 * x * y, atol=1e-12)


# Look-up in kernels


def start(count: int, terrain: Terrain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and targets of robots near the ground, some with feet in it."""
    rng = np.random.default_rng(0)
    q = np.tile(ROBOT.standing_q, (count, 1))
    q[:, :2] = rng.uniform(-2, 2, (count, 2))
    q[:, 2] += rng.uniform(-0.01, 0.05, count) + terrain.at(q[:, 0], q[:, 1])[:, 0]
    q[:, 7:] += rng.normal(0, 0.2, (count, 2))
    return q, rng.normal(0, 0.5, (count, ROBOT.nv)), q[:, 7:] + rng.normal(0, 0.2, (count, 2))


def run(terrain: Terrain | None, state, rows=slice(None), n_substeps: int = 10, **options) -> Simulator:
    q, v, target = (x[rows] for x in state)
    sim = Simulator(ROBOT, len(q), terrain=terrain, **options)
    sim.set_state(q, v)
    sim.step(target, n_substeps)
    return sim


def test_flat_scenes_pay_nothing():
    """Without terrain there is not one instruction, buffer or look-up more."""
    options = Simulator(ROBOT).options
    plain = StepOptions(contacts=options.contacts, material=options.material)
    counts = [iteration_function(ROBOT.mechanism, o).n_instructions() for o in (options, plain)]
    assert counts[0] == counts[1]
    assert iteration_function(ROBOT.mechanism, replace(options, ground="field")).n_instructions() > counts[0]
    sizes, further, _ = substeps(ROBOT.mechanism, options, ())
    assert "frame" not in sizes
    assert not {"ground", "places", "heights"} & ({b.name for b in further} | set(sizes))


def test_a_flat_field_is_flat_ground():
    state = start(24, Terrain.flat())
    flat, field = run(None, state), run(Terrain.flat(), state)
    np.testing.assert_allclose(field.q, flat.q, rtol=0, atol=1e-11)
    np.testing.assert_allclose(field.v, flat.v, rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_kernel_sees_the_surface(dtype: str):
    """The traced step, given the plane that each sphere of a robot meets by numpy, makes the same step."""
    terrain = Terrain.rough(1, 0.05, cell=0.2, size=4.0)
    q, v, target = state = start(20, terrain)
    sim = run(terrain, state, n_substeps=1, dtype=dtype)
    function = step_function(ROBOT.mechanism, replace(sim.options, dt=sim.dt))
    centres, _ = ROBOT.contact_points(q, v)
    radius = np.array([sphere.radius for sphere in ROBOT.robot.contacts])[:, None]
    under = terrain.at(centres[..., 0], centres[..., 1])
    lean = radius * under[..., 1:] / np.sqrt(1 + (under[..., 1:] ** 2).sum(-1, keepdims=True))
    touching = centres[..., :2] + lean
    ground = terrain.at(touching[..., 0], touching[..., 1])
    ground[..., 0] -= (ground[..., 1:] * lean).sum(-1)
    n = len(sim.contact_names)
    tolerance = {"float64": 1e-9, "float32": 2e-2}[dtype]
    for i in range(20):
        results = function(q[i], v[i], sim._resting_load(q[i]), np.zeros(2 * n), 0.0, target[i], ground[i].ravel())
        np.testing.assert_allclose(sim.v[i], np.array(results[1]).ravel(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_results_do_not_depend_on_batch_or_threads(dtype: str):
    terrain = Terrain.rough(2, 0.04, cell=0.1, size=4.0)
    state = start(40, terrain)
    whole = run(terrain, state, dtype=dtype)
    threaded = run(terrain, state, dtype=dtype, num_threads=2)
    np.testing.assert_array_equal(whole.q, threaded.q)
    for rows in (slice(0, 1), slice(3, 10), slice(17, 40)):
        part = run(terrain, state, rows, dtype=dtype)
        np.testing.assert_array_equal(part.q, whole.q[rows])
        np.testing.assert_array_equal(part.v, whole.v[rows])


def test_a_lost_place_stays_in_its_lane():
    terrain = Terrain.rough(2, 0.04, cell=0.1, size=4.0)
    q, v, target = state = start(24, terrain)
    clean, sim = run(terrain, state), Simulator(ROBOT, 24, terrain=terrain)
    sim.set_state(q, v)
    sim._arrays["q"][1, 0, 3] = np.nan  # robot 11
    sim._arrays["q"][2, 1, 1] = 1e300  # robot 17
    sim.step(target, 10)
    others = ~np.isin(np.arange(24), [11, 17])
    assert sim.diverged[11]
    np.testing.assert_array_equal(sim.q[others], clean.q[others])
    np.testing.assert_array_equal(sim.v[others], clean.v[others])


# Slopes


@pytest.mark.slow
@pytest.mark.parametrize(("method", "radius"), [*((method, 0.03) for method in METHODS), ("euler", 0.0)])
def test_a_slope_is_flat_ground_under_tilted_gravity(method: str, radius: float):
    """A block with spin, sliding: the same motion seen from the slope, whatever the method and the heading."""
    angle, heading, dt = 0.35, 0.8, 0.002 if METHODS[method].order < 3 else 5e-5
    R, quaternion = tilted(angle, heading)
    robot = replace(block(0.4, radius), material=ContactMaterial(5e4, 500.0, 0.4, 0.1, 0.0))
    down = Model(replace(robot, gravity=tuple(R.T @ [0.0, 0.0, -G])))
    v = np.array([0.2, -0.1, 1.5, 0.8, -0.5, 0.0])
    flat = Simulator(down, 1, dt, method=method)
    slope = Simulator(Model(robot), 1, dt, method=method, terrain=Terrain.slope(angle, heading))
    flat.set_state([0.0, 0.0, 0.0498, 1.0, 0.0, 0.0, 0.0], v)
    slope.set_state([*(R @ [0.0, 0.0, 0.0498]), *quaternion], v)
    for sim in (flat, slope):
        sim.step(NOTHING, 200)
    np.testing.assert_allclose(slope.q[0, :3], R @ flat.q[0, :3], atol=1e-9)
    np.testing.assert_allclose(slope.v[0], flat.v[0], atol=1e-7)


@pytest.mark.parametrize("angle", [0.3, 0.42, 0.5, 0.7])
def test_a_block_slides_and_sticks_as_coulomb_says(angle: float):
    mu, heading = 0.5, 2.1
    R, quaternion = tilted(angle, heading)
    sim = Simulator(Model(block(mu)), 1, 0.004, terrain=Terrain.slope(angle, heading))
    sim.set_state([*(R @ [0.0, 0.0, 0.05 - 5.0 * G * np.cos(angle) / 4 / 5e4]), *quaternion], np.zeros(6))
    sim.step(NOTHING, 250)
    before = sim.v[0, 3:]
    sim.step(NOTHING, 250)
    acceleration = np.linalg.norm(sim.v[0, 3:] - before)
    expected = max(G * (np.sin(angle) - mu * np.cos(angle)), 0.0)
    assert acceleration == pytest.approx(expected, rel=1e-3, abs=1e-4)
    if expected == 0:
        assert np.abs(sim.v).max() < 1e-5


# Bumps


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.0, 0.02])
@pytest.mark.parametrize("mu", [0.0, 0.8])
def test_bumps_give_no_energy(radius: float, mu: float):
    """Points and balls that bounce and roll over many cells, from patch to patch.

    The ground under a contact is a plane for the length of a step, so the energy gained on a curve falls with the
    step; and it is a small part of the ball's energy.
    """
    terrain, model = Terrain.rough(1, 0.02, cell=0.1, size=12.0), Model(ball(radius, mu))
    gains = []
    for dt in (0.004, 0.001):
        sim, rng = Simulator(model, 64, dt, terrain=terrain, outputs=()), np.random.default_rng(0)
        q, v = np.zeros((64, 7)), np.zeros((64, 6))
        q[:, 3] = 1.0
        q[:, :2] = rng.uniform(-4, 4, (64, 2))
        q[:, 2] = terrain.at(q[:, 0], q[:, 1])[:, 0] + radius + rng.uniform(0, 0.3, 64)
        v[:, 3:5] = rng.normal(0, 1.5, (64, 2))
        sim.set_state(q, v)
        energy = [mechanical_energy(sim, terrain, radius)]
        for _ in range(round(1.5 / dt)):
            sim.step(NOTHING, 1)
            energy.append(mechanical_energy(sim, terrain, radius))
        lowest = np.minimum.accumulate(energy, axis=0)
        gains.append((energy - lowest).max())
        assert (np.max(energy, axis=0) - energy[0]).max() < 1e-6
    assert gains[1] < max(0.5 * gains[0], 1e-9)
    assert gains[1] < 0.02  # of about 6 J


def mechanical_energy(sim: Simulator, terrain: Terrain, radius: float) -> np.ndarray:
    """Kinetic, of height, and of the springs of a ball's contact [J], shape (num_envs,)."""
    q, ground = sim.q, terrain.at(*sim.q.T[:2])
    lean = radius * ground[:, 1:] / np.sqrt(1 + (ground[:, 1:] ** 2).sum(1))[:, None]
    plane = terrain.at(*(q[:, :2] + lean).T)
    cosine = 1 / np.sqrt(1 + (plane[:, 1:] ** 2).sum(1))
    depth = np.maximum(radius - cosine * (q[:, 2] - plane[:, 0] + (plane[:, 1:] * lean).sum(1)), 0)
    anchor = np.array(sim._arrays["anchor"]).transpose(0, 2, 1).reshape(-1, 2)[: sim.num_envs]
    stretch = (anchor**2).sum(1) + (anchor * plane[:, 1:]).sum(1) ** 2
    kinetic, potential = sim.model.energy(q, sim.v)
    return kinetic + potential + 0.5 * 5e4 * (depth**2 + stretch)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_robot_stands_on_rough_ground(dtype: str):
    terrain = Terrain.rough(5, 0.03, cell=0.1, size=6.0)
    sim = Simulator(ROBOT, 16, dtype=dtype, terrain=terrain)
    rng = np.random.default_rng(3)
    q = np.tile(ROBOT.standing_q, (16, 1))
    q[:, :2] = rng.uniform(-2.5, 2.5, (16, 2))
    q[:, 2] += 0.06
    sim.set_state(q, np.zeros(ROBOT.nv))
    sim.step(ROBOT.standing_q[7:], 2000)
    assert not sim.diverged.any()
    assert np.abs(sim.v).max() < 0.02
    weight = ROBOT.total_mass * G
    np.testing.assert_allclose(sim.contact_forces.sum(axis=1), np.tile([0.0, 0.0, weight], (16, 1)), atol=0.01 * weight)
    places = np.floor(sim.q[:, :2] / 0.1)
    assert len(np.unique(places, axis=0)) > 10  # they stand in different cells


# Simulator


@pytest.mark.parametrize(
    "terrain", [Terrain.slope(0.2, 0.5), Terrain.rough(7, 0.05), Terrain.stairs(0.1, 0.3, 5, -0.6)]
)
def test_reset_puts_robots_on_the_ground(terrain: Terrain):
    """The lowest foot is as deep as in flat ground, to the radius that a sphere has on the side; no other is deeper."""
    sim = Simulator(ROBOT, 2, terrain=terrain)
    np.testing.assert_array_equal(np.delete(sim.q[0], 2), np.delete(ROBOT.standing_q, 2))
    np.testing.assert_array_equal(sim.q[0], sim.q[1])
    centres, _ = ROBOT.contact_points(sim.q[0], np.zeros(ROBOT.nv))
    radius = np.array([sphere.radius for sphere in ROBOT.robot.contacts])
    ground = terrain.at(centres[:, 0], centres[:, 1])
    depth = radius - (centres[:, 2] - ground[:, 0]) / np.sqrt(1 + (ground[:, 1:] ** 2).sum(1))
    assert abs(depth.max()) < 1e-3
    load = sim._resting_load(sim.q[0])
    np.testing.assert_allclose(load, sim.options.material.stiffness * np.maximum(depth, 0), atol=1e-6)


def test_terrain_without_contacts_is_not_looked_at():
    sim = Simulator(ROBOT, terrain=Terrain.slope(0.3), contacts=())
    assert sim.options.ground == "flat"
    sim.step(ROBOT.standing_q[7:], 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Terrain(np.zeros((2, 5)), 0.1), r"heights has shape \(2, 5\); expected \(rows, columns\), 3 or more"),
        (lambda: Terrain(np.full((3, 3), np.nan), 0.1), "heights holds a number that is not finite"),
        (lambda: Terrain(np.zeros((3, 3)), 0.0), "cell=0.0; expected a length above 0 m"),
        (lambda: Terrain(np.zeros((3, 3)), 0.1, (0.0, np.inf)), r"origin=\(0.0, inf\); expected two finite numbers"),
        (lambda: Terrain.slope(1.6), "angle=1.6; expected less than a right angle"),
        (lambda: Terrain.rough(0, -0.1), "amplitude=-0.1; expected a length from 0 to 10000 m"),
        (lambda: Terrain.rough(0, 0.1, 0.1, 0.1), "size=0.1; expected at least two cells"),
        (lambda: Terrain.stairs(0.1, 0.03, 3), "tread=0.03; expected at least two cells"),
        (lambda: Terrain.stairs(0.1, 0.3, 0), "count=0; expected a whole number, at least 1"),
        (lambda: Terrain.from_function(lambda x, y: x[0], 0.1, 1.0), r"function returns shape \(11,\); expected"),
        (lambda: Simulator(ROBOT, terrain="hills"), "terrain='hills'; expected a Terrain or None"),
    ],
)
def test_bad_arguments(make, message: str):
    with pytest.raises(ValueError, match=f"^{message}") as error:
        make()
    assert "\n" not in str(error.value)
