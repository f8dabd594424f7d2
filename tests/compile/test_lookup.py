"""Looking up a surface over a table: values, slopes, borders, and coordinates that are no place at all."""

import numpy as np
import pytest

from ce_gym.compile import Buffer, Lookup, Program, aligned_zeros, load_kernel

N = 5
TOLERANCE = {"float64": 1e-12, "float32": 2e-5}


def program():
    buffers = (
        Buffer("table", 0, "table"),
        Buffer("frame", 3, "rows_in"),
        Buffer("points", 2 * N, "rows_in"),
        Buffer("found", 3 * N, "rows_out"),
    )
    return Program("lookup", buffers, (Lookup("table", "frame", "points", "found"),))


@pytest.fixture(scope="module", params=["float64", "float32"])
def kernel(request):
    return load_kernel("lookup", program, request.param)


def look_up(kernel, table, points, frame=(0.0, 0.0, 1.0), num_threads=1):
    """Values and slopes, shape (n, N, 3), at points of shape (n, N, 2)."""
    n, found = len(points), np.full((len(points), 3 * N), np.nan, kernel.dtype)
    arrays = {
        "table": np.ascontiguousarray(table, kernel.dtype),
        "frame": np.ascontiguousarray(np.broadcast_to(frame, (n, 3)), kernel.dtype),
        "points": np.ascontiguousarray(points.reshape(n, 2 * N), kernel.dtype),
        "found": found,
    }
    kernel(arrays, n, num_threads=num_threads)
    return found.reshape(n, N, 3)


def basis(x: float, i: int) -> float:
    """The uniform quadratic B-spline about i, by the recursion of Cox and de Boor."""

    def recursion(order: int, left: float) -> float:
        if order == 0:
            return float(left <= x < left + 1)
        weight = (x - left) / order
        return weight * recursion(order - 1, left) + (1 - (x - left - 1) / order) * recursion(order - 1, left + 1)

    return recursion(2, i - 1.5)


def surface(table: np.ndarray, x: float, y: float) -> float:
    """The same surface from its definition: a sum over all entries of a table extended straight on by 40 cells."""
    rows, columns = table.shape
    i, j = np.arange(-40, rows + 40), np.arange(-40, columns + 40)

    def extended(k, n):
        inner = np.clip(k, 0, n - 1)
        neighbour = np.where(k < 0, 1, np.where(k > n - 1, n - 2, inner))
        return inner, neighbour, np.abs(k - inner)

    ri, rn, rd = extended(i, rows)
    tall = table[ri] + rd[:, None] * (table[ri] - table[rn])
    ci, cn, cd = extended(j, columns)
    wide = tall[:, ci] + cd * (tall[:, ci] - tall[:, cn])
    return np.array([basis(x, k) for k in i]) @ wide @ np.array([basis(y, k) for k in j])


def test_values_and_slopes(kernel):
    rng = np.random.default_rng(0)
    table, frame = rng.normal(0, 0.3, (7, 11)), (-1.3, 0.4, 0.25)
    cells = np.concatenate([rng.uniform((0, 0), (6, 10), (60, 2)), rng.uniform(-20, 30, (40, 2))])
    found = look_up(kernel, table, (cells * frame[2] + frame[:2]).reshape(-1, N, 2), frame).reshape(-1, 3)
    h = 1e-4
    for (x, y), got in zip(cells, found, strict=True):
        dx = (surface(table, x + h, y) - surface(table, x - h, y)) / (2 * h * frame[2])
        dy = (surface(table, x, y + h) - surface(table, x, y - h)) / (2 * h * frame[2])
        scale = 1 + max(abs(x), abs(y)) ** 2  # the straight continuation magnifies rounding with the distance
        assert got[0] == pytest.approx(surface(table, x, y), abs=TOLERANCE[kernel.dtype] * scale)
        assert got[1:] == pytest.approx([dx, dy], abs=(5e-4 + TOLERANCE[kernel.dtype]) * scale)


def test_a_plane_is_met_exactly_and_for_ever(kernel):
    i, j = np.meshgrid(np.arange(4), np.arange(5), indexing="ij")
    points = np.random.default_rng(1).uniform(-50, 50, (20, N, 2))
    found = look_up(kernel, 0.2 * i - 0.3 * j + 1, points)
    expected = 0.2 * points[..., 0] - 0.3 * points[..., 1] + 1
    np.testing.assert_allclose(found[..., 0], expected, atol=100 * TOLERANCE[kernel.dtype])
    np.testing.assert_allclose(found[..., 1], 0.2, atol=100 * TOLERANCE[kernel.dtype])
    np.testing.assert_allclose(found[..., 2], -0.3, atol=100 * TOLERANCE[kernel.dtype])


def test_values_and_slopes_are_continuous(kernel):
    """Across every line where one patch ends, borders included, nothing jumps."""
    table = np.random.default_rng(2).normal(0, 1, (5, 5))
    rng, eps = np.random.default_rng(3), 1e-9 if kernel.dtype == "float64" else 1e-6
    seams = np.arange(-0.5, 5.5, 0.5)
    along = rng.uniform(-2, 6, len(seams) * N)
    across = np.repeat(seams, N)
    for flip in (1, -1):
        sides = [
            look_up(kernel, table, np.stack([across + side * eps, along][::flip], -1).reshape(-1, N, 2))
            for side in (1, -1)
        ]
        np.testing.assert_allclose(*sides, atol=100 * eps)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e300])
def test_a_place_that_is_none_harms_nobody(kernel, bad):
    """Results of other lanes do not change, and nothing outside the table is read, which would end the process."""
    rng = np.random.default_rng(4)
    table, points = rng.normal(0, 1, (3, 3)), rng.uniform(0, 2, (40, N, 2))
    clean = look_up(kernel, table, points)
    points[11, 2], points[12, 3, 1] = bad, bad
    with np.errstate(over="ignore"):
        found = look_up(kernel, table, points)
    others = np.ones((40, N), bool)
    others[11, 2] = others[12, 3] = False
    np.testing.assert_array_equal(found[others], clean[others])
    if np.isnan(bad):
        assert np.isnan(found[~others][:, 0]).all()  # and the result is NaN, too


def test_batch_and_threads_do_not_matter(kernel):
    rng = np.random.default_rng(5)
    table, points = rng.normal(0, 1, (9, 8)), rng.uniform(-1, 9, (100, N, 2))
    whole = look_up(kernel, table, points)
    np.testing.assert_array_equal(look_up(kernel, table, points, num_threads=3), whole)
    for rows in (slice(0, 1), slice(3, 20), slice(17, 100)):
        np.testing.assert_array_equal(look_up(kernel, table, points[rows]), whole[rows])


def test_one_kernel_takes_tables_of_any_shape(kernel):
    points = np.full((1, N, 2), 1.0)
    for shape in ((3, 3), (3, 200), (200, 3)):
        assert look_up(kernel, np.full(shape, 0.7), points)[0, 0] == pytest.approx([0.7, 0, 0], abs=1e-6)


@pytest.mark.parametrize("table", [np.zeros((2, 5)), np.zeros(9), np.zeros((3, 2**23 + 1), np.int8)])
def test_wrong_tables(kernel, table):
    with pytest.raises(
        ValueError, match=r"^kernel 'lookup': table 'table' is \(.*\), expected \(rows, columns\), 3 to"
    ):
        look_up(kernel, table, np.zeros((1, N, 2)))


def test_missing_tables_and_wrong_dtypes(kernel):
    arrays = {"frame": aligned_zeros((1, 3), kernel.dtype), "points": aligned_zeros((1, 2 * N), kernel.dtype)}
    arrays["found"] = aligned_zeros((1, 3 * N), kernel.dtype)
    with pytest.raises(ValueError, match="table 'table' is nothing"):
        kernel(arrays, 1)
    with pytest.raises(ValueError, match="array 'table' is int64"):
        kernel(arrays | {"table": np.zeros((3, 3), np.int64)}, 1)


TABLE, A, B, C = Buffer("t", 0, "table"), Buffer("a", 3, "tiles"), Buffer("b", 4, "tiles"), Buffer("c", 6, "scratch")
D = Buffer("d", 2, "scratch")
WRONG = {
    "buffer 't': size 3, expected 0 for a table": Program("p", (Buffer("t", 3, "table"),), ()),
    "expected the name of a table buffer": Program("p", (A, B, C), (Lookup("a", "a", "b", "c"),)),
    "frame buffer 'f' is not among": Program("p", (TABLE, A, B, C), (Lookup("t", "f", "b", "c"),)),
    "frame buffer 't' is a table": Program("p", (TABLE, A, B, C), (Lookup("t", "t", "b", "c"),)),
    "points buffer 'a' has size 3, expected 2": Program("p", (TABLE, A, B), (Lookup("t", "a", "a", "b"),)),
    "frame buffer 'b' has size 4, expected 3": Program("p", (TABLE, A, B, C), (Lookup("t", "b", "b", "c"),)),
    "output buffer 'd' has size 2, expected 6": Program("p", (TABLE, A, B, D), (Lookup("t", "a", "b", "d"),)),
    "slopes of a grid, expected values alone": Program(
        "p", (TABLE, A, B, C), (Lookup("t", "a", "b", "c", grid=((0.0, 0.0),)),)
    ),
    "output buffer 'c' has size 6, expected 2": Program(
        "p", (TABLE, A, B, C), (Lookup("t", "a", "b", "c", slopes=False, grid=((0.0, 0.0), (1.0, 0.0))),)
    ),
    "output 'a' is an input too": Program("p", (TABLE, A, B), (Lookup("t", "a", "b", "a"),)),
    "reads 'd', expected an earlier call": Program(
        "p", (TABLE, A, D, Buffer("e", 3, "tiles")), (Lookup("t", "a", "d", "e"),)
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_programs(message):
    with pytest.raises(ValueError, match=f"^program 'p': .*{message}") as error:
        load_kernel(message, lambda: WRONG[message])
    assert "\n" not in str(error.value)


def test_values_alone_are_the_same(kernel):
    """To rounding, inside and outside, more points than fit into one chunk; NaN reads the table, too."""
    n = 21
    buffers = (Buffer("table", 0, "table"), Buffer("frame", 3, "rows_in"), Buffer("points", 2 * n, "rows_in"))
    program = Program("values", (*buffers, Buffer("found", n, "rows_out")), (
        Lookup("table", "frame", "points", "found", slopes=False),
    ))  # fmt: skip
    table = np.random.default_rng(5).normal(0, 0.3, (7, 11))
    points = np.random.default_rng(6).uniform(-8, 15, (3, n, 2)).astype(kernel.dtype)
    points[0, 0], points[1, 1] = (np.nan, 2.0), (np.inf, -np.inf)
    found = np.full((3, n), np.nan, kernel.dtype)
    arrays = {"table": np.ascontiguousarray(table, kernel.dtype), "points": points.reshape(3, -1), "found": found}
    arrays["frame"] = np.ascontiguousarray(np.broadcast_to((-1.3, 0.4, 0.25), (3, 3)), kernel.dtype)
    load_kernel("values", lambda: program, kernel.dtype)(arrays, 3)
    both = np.concatenate([points.reshape(-1, 2), points.reshape(-1, 2)[:2]]).reshape(-1, N, 2)
    expected = look_up(kernel, table, both, (-1.3, 0.4, 0.25)).reshape(-1, 3)[: 3 * n, 0]
    known = np.isfinite(expected)
    assert known.sum() == 3 * n - 2
    np.testing.assert_allclose(found.ravel()[known], expected[known], rtol=0, atol=TOLERANCE[kernel.dtype] * 1e3)


GRID = tuple((float(x), float(y)) for x in (-0.75, 0.1, 0.5) for y in np.linspace(-0.5, 0.625, 7))


def grid_program():
    buffers = (Buffer("table", 0, "table"), Buffer("frame", 3, "rows_in"), Buffer("pose", 6, "rows_in"))
    found = Buffer("found", 2 * len(GRID), "rows_out")
    return Program("grid", (*buffers, found), (Lookup("table", "frame", "pose", "found", slopes=False, grid=GRID),))


@pytest.fixture(scope="module")
def grid_kernel(kernel):
    return load_kernel("grid", grid_program, kernel.dtype)


def look_around(kernel, table, pose, frame=(-1.3, 0.4, 0.25)):
    """Values, shape (n, 2, points), of grids turned by an angle and put at two places, pose of shape (n, 5)."""
    turned = np.column_stack([np.cos(pose[:, 0]), np.sin(pose[:, 0]), pose[:, 1:]])
    found = np.full((len(pose), 2 * len(GRID)), np.nan, kernel.dtype)
    arrays = {"table": np.ascontiguousarray(table, kernel.dtype), "pose": turned.astype(kernel.dtype), "found": found}
    arrays["frame"] = np.ascontiguousarray(np.broadcast_to(frame, (len(pose), 3)), kernel.dtype)
    kernel(arrays, len(pose))
    return found.reshape(len(pose), 2, -1)


def test_grids_are_turned_and_put_in_place(kernel, grid_kernel):
    """In the middle of the table, across its border and beyond, point by point from the definition of the surface."""
    table = np.random.default_rng(7).normal(0, 0.3, (14, 15))
    pose = np.array([[0.7, 0.4, 2.1, 0.2, 2.0], [-2.0, -1.2, 3.6, 1.0, 0.5], [3.0, 5.0, 2.0, 0.4, -2.0]])
    found = look_around(grid_kernel, table, pose)
    for (angle, *places), heights in zip(pose, found, strict=True):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for place, values in zip(np.reshape(places, (2, 2)), heights, strict=True):
            at = (place + np.array(GRID) @ turn.T - [-1.3, 0.4]) / 0.25
            expected = [surface(table, x, y) for x, y in at]
            scale = 1 + np.abs(at).max() ** 2
            np.testing.assert_allclose(values, expected, rtol=0, atol=scale * TOLERANCE[kernel.dtype])


def test_grids_do_not_depend_on_who_is_near_the_border(grid_kernel):
    """A tile looks the short way only if all its lanes are far from the border; no bit shows which way it was."""
    table, n = np.random.default_rng(8).normal(0, 0.3, (40, 40)), 40
    rng = np.random.default_rng(9)
    middle = np.column_stack([rng.uniform(-3, 3, n), rng.uniform((2, 4, 2, 4), (5, 7, 5, 7), (n, 4))])
    alone, mixed = look_around(grid_kernel, table, middle), middle.copy()
    mixed[::5, 1:3], mixed[1, 0], mixed[11, 1], mixed[3, 4] = [-1.2, 9.0], np.nan, np.nan, np.inf
    kept = (mixed == middle).all(axis=1)
    assert 20 < kept.sum() < 35
    np.testing.assert_array_equal(look_around(grid_kernel, table, mixed)[kept], alone[kept])


def test_a_level_table_is_met_without_rounding(grid_kernel):
    """Weights of a point add up to 1 in whatever precision."""
    pose = np.random.default_rng(10).uniform(-5, 12, (20, 5))
    assert (look_around(grid_kernel, np.full((30, 30), 0.1), pose) == np.array(0.1, grid_kernel.dtype)).all()
