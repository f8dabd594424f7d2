"""State that is saved, copied and pickled goes on bit for bit; a schema that fits the kernels."""

from __future__ import annotations

import copy
import os
import pickle
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, Terrain
from ce_gym.sim.schema import physics_rows
from ce_gym.sim.substeps import substeps

READ = ("q", "v", "torque", "contact_forces")


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(TRIPOD)


@pytest.fixture(scope="module")
def sim(model: Model) -> Simulator:
    """Moving robots, one frozen; with parameters, and on a field."""
    sim = Simulator(model, 11, terrain=Terrain.rough(0, 0.02), parameters=("friction", "kp"), retry=1)
    sim.set_parameter("friction", np.linspace(0.4, 0.9, 11)[:, None])
    v = np.random.default_rng(0).normal(0, 0.5, (11, model.nv))
    v[4] = 1e8
    sim.set_state(sim.q, v)
    sim.step(model.standing_q[7:], 7)
    assert sim.diverged.tolist() == [i == 4 for i in range(11)]
    return sim


def goes_on_like(one: Simulator, other: Simulator) -> None:
    """Both step on alike; counts of failures and parameters are the same too."""
    target = one.model.standing_q[7:] + 0.1
    for each in (one, other):
        each.step(target, 5)
    for name in READ:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.n_diverged, one.n_retried) == (other.n_diverged, other.n_retried)
    for each in (one, other):
        each.reset(each.diverged)
    assert one.n_diverged == other.n_diverged == 1


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, copy.copy, lambda sim: pickle.loads(pickle.dumps(sim))],
    ids=["deepcopy", "copy", "pickle"],
)
def test_a_copy_goes_on_by_itself(sim: Simulator, copied):
    original = copy.deepcopy(sim)
    goes_on_like(original, copied(sim))


def test_a_snapshot_is_continued(sim: Simulator, model: Model, tmp_path: Path):
    snapshot = sim.snapshot(tmp_path / "state")
    kept = {name: rows.copy() for name, rows in snapshot.items()}
    expected = copy.deepcopy(sim)
    other, third = copy.deepcopy(sim), copy.deepcopy(sim)
    for each in (other, third):
        each.step(model.standing_q[7:] - 0.3, 9)
        each.set_parameter("friction", 0.1)
        each.reset()
    other.restore(snapshot)
    third.restore(tmp_path / "state")
    goes_on_like(copy.deepcopy(expected), third)
    goes_on_like(expected, other)
    for name, rows in snapshot.items():
        np.testing.assert_array_equal(rows, kept[name], err_msg=name)


def test_what_is_no_snapshot_of_it_is_refused(sim: Simulator, model: Model, tmp_path: Path):
    plain = Simulator(model, 11)
    before = plain.snapshot()
    with pytest.raises(ValueError, match=r"snapshot: 'frame' is not part of this state; expected one of the same"):
        plain.restore(sim.snapshot())
    with pytest.raises(ValueError, match=r"snapshot: 'q' is float64 \(11, 8\); expected float64 \(11, 9\)"):
        plain.restore({**before, "q": before["q"][:, 1:]})
    with pytest.raises(ValueError, match=r"snapshot: 'failures' is missing"):
        plain.restore({name: rows for name, rows in before.items() if name != "failures"})
    for name, content in {"text": b"walk", "empty": b"", "cut": b"PK\x03\x04"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"expected a file that `snapshot` wrote") as caught:
            plain.restore(tmp_path / name)
        assert "\n" not in str(caught.value)
    np.savez(tmp_path / "objects.npz", q=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="elements of type object"):
        plain.restore(tmp_path / "objects.npz")
    for name, rows in plain.snapshot().items():
        np.testing.assert_array_equal(rows, before[name], err_msg=name)


@pytest.mark.parametrize("robot", [TRIPOD, "six_bar", "mit_humanoid_leg"])
def test_the_schema_is_what_the_kernel_has(robot: str):
    """Every state buffer of a compiled program is in the schema, with its size, and vice versa."""
    sim = Simulator(Model(robot), outputs=("torque", "power", "contact_forces", "motor_speed", "energy"), retry=0)
    lanes = {row.name: row.size for row in sim._batch.schema.values() if not row.dtype}
    assert lanes == {name: b.size for name, b in sim._kernel.buffers.items() if b.kind == "tiles"}


def test_the_schema_is_what_the_sub_steps_need(sim: Simulator, model: Model):
    """With parameters, on a field, with an error estimate, before anything is compiled."""
    outputs = ("torque", "error")
    sizes, *_ = substeps(model.mechanism, sim.options, outputs)
    rows = {row.name: row.size for row in physics_rows(model, sim.options, outputs, sim.dt)}
    assert rows == {name: size for name, size in sizes.items() if name != "target"}


def test_a_diverged_robot_reports_numbers(model: Model):
    sim = Simulator(model, 3, outputs=("torque", "contact_forces", "power", "energy"))
    v = np.zeros((3, model.nv))
    v[1] = 1e30
    sim.set_state(sim.q, v)
    sim.step(model.standing_q[7:])
    assert sim.diverged.tolist() == [False, True, False]
    for name in ("torque", "contact_forces", "power", "energy"):
        told = getattr(sim, name)
        assert not told[1].any(), f"{name} of a frozen robot is 0"
        assert told[0].any(), name


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("friction", -0.1, "friction=-0.1; expected 0 or more, up to 1e+12 [-]"),
        ("stiffness", -1.0, "stiffness=-1; expected 0 or more, up to 1e+12 [N/m]"),
        ("ratio", 0.0, "ratio=0; expected more than 0, from 1e-12 to 1e+12 [-]"),
        ("slip_speed", 0.0, "slip_speed=0; expected more than 0, from 1e-12 to 1e+12 [m/s]"),
        ("kp", np.array([1.0, -2.0]), "kp=-2; expected 0 or more, up to 1e+12 [N m/rad or N/m]"),
        (
            "added_mass:plate",
            -50.0,
            "added_mass:plate=-50; expected more than -3 kg, what the body has",
        ),
        ("gravity", [0.0, 0.0, np.nan], "gravity=nan; expected finite numbers, up to 1e+12 in size [m/s^2]"),
    ],
)
def test_parameters_have_ranges(model: Model, name: str, value, expected: str):
    sim = Simulator(
        model,
        2,
        parameters=("friction", "stiffness", "ratio", "slip_speed", "kp", "added_mass:plate", "gravity"),
    )
    before = sim.snapshot()["parameters"]
    with pytest.raises(ValueError, match="expected") as caught:
        sim.set_parameter(name, value)
    assert str(caught.value) == expected
    np.testing.assert_array_equal(sim.snapshot()["parameters"], before)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("q", np.nan, "'q' holds nan; expected a finite number"),
        ("v", np.inf, "'v' holds inf; expected a finite number"),
        ("parameters", -1.0, "friction=-1; expected 0 or more"),
        ("failures", -5, "'failures' holds -5; expected a number from 0"),
        ("diverged", 2.0, "'diverged' holds 2; expected a number from 0 to 1"),
        ("frame", 0.0, "'frame' differs; expected one on the same ground"),
    ],
)
def test_a_snapshot_has_the_ranges_of_states_and_parameters(sim: Simulator, name: str, value: float, message: str):
    before = sim.snapshot()
    wrong = {key: rows.copy() for key, rows in before.items()}
    wrong[name].reshape(-1)[0] = value
    with pytest.raises(ValueError, match=message):
        sim.restore(wrong)
    for key, rows in sim.snapshot().items():
        np.testing.assert_array_equal(rows, before[key], err_msg=key)


def test_files_made_to_harm_are_one_line_and_soon(sim: Simulator, tmp_path: Path):
    sim.snapshot(tmp_path / "good")
    data = (tmp_path / "good").read_bytes()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as bomb, bomb.open("q.npy", "w") as member:
        for _ in range(2**10):
            member.write(bytes(2**20))
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "large", "w") as large:
        large.writestr("q.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    rng = random.Random(0)
    for number in range(60):
        damaged = bytearray(data)
        for _ in range(rng.choice((1, 3, 30))):
            damaged[rng.randrange(len(data))] = rng.randrange(256)
        (tmp_path / f"damaged{number}").write_bytes(damaged[: rng.choice((len(data), rng.randrange(len(data))))])
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for file in sorted(tmp_path.iterdir()):
        if file.name == "good":
            continue
        copied, error = copy.deepcopy(sim), ""
        try:
            copied.restore(file)
        except ValueError as refusal:
            error = str(refusal)
        if error:
            assert "\n" not in error
            assert "expected" in error
        else:
            assert file.name.startswith("damaged")  # a changed number may still be in range
            assert all(np.isfinite(rows).all() for rows in (copied.q, copied.v))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**16  # [KiB]
