"""The paper's figures on small cases: what follows from counts, what is on file, and what is written."""

import argparse
import csv
from itertools import pairwise

import pytest

from ce_gym.bench.paper import benchmark as paper
from ce_gym.bench.paper import counts as paper_counts
from ce_gym.bench.paper import reference as paper_reference
from ce_gym.bench.paper.counts import crossover, increments

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
LINEAR = ("link_and_rotor", "belt_pair", "transmission_parallel")


@pytest.fixture
def without_loops(monkeypatch):
    """Leave out chains with closed loops, which take longer to trace."""
    for table in (paper_counts.BRANCHED, paper_counts.PARALLEL):
        for chain in [name for name in table if name not in LINEAR]:
            monkeypatch.delitem(table, chain)


def test_counts_on_file():
    chains = {(c.chain, c.branches, c.depth, c.loop_size): c for c in paper_reference.chain_references()}
    assert len(chains) == 148
    assert {c.chain for c in chains.values()} == {*paper_counts.BRANCHED, *paper_counts.PARALLEL}
    assert chains["link_and_rotor", 6, 10, None].proximal == 758469
    assert chains["rod_parallel", None, 40, 41].ce_aba == 669192
    assert chains["belt_pair", 2, 3, None].lagrange is None
    robots = paper_reference.robot_references()
    assert (robots["mini_cheetah"].ce_aba, robots["mini_cheetah"].approximate) == (11133, 7222)
    assert robots["tello_with_arms"].paper_saving == 55.1


def test_library_is_linear_and_proximal_is_not():
    """The counts on file show what the paper says they do, so a slip in copying them would be seen."""
    for chain in paper_counts.BRANCHED:
        for branches in (1, 2, 4, 6):
            rows = [c for c in paper_reference.chain_references() if (c.chain, c.branches) == (chain, branches)]
            library = increments([c.ce_aba for c in rows])
            assert max(library) - min(library) <= 2
            proximal = increments([c.proximal or 0 for c in rows])
            assert all(a < b for a, b in pairwise(proximal))


def test_crossover():
    assert crossover([2, 4, 8], [1, 2, 4], [8, 4, 2]) == pytest.approx(32**0.5)
    assert crossover([2, 4, 8], [1, 1, 1], [2, 2, 2]) is None
    assert crossover([2, 4], [3, 3], [2, 2]) == 2.0


def test_ours_are_linear_in_depth_and_below_the_library(without_loops):
    counts = paper_counts.branched_counts([1, 2], 5)
    assert len(counts) == 20
    for chain in ("link_and_rotor", "belt_pair"):
        for branches in (1, 2):
            rows = [c for c in counts if (c.reference.chain, c.reference.branches) == (chain, branches)]
            for variant in paper_counts.VARIANTS:
                steps = increments([c.ours[variant] for c in rows])
                assert max(steps) - min(steps) <= paper.LARGEST_SPREAD
            assert all(c.ours["none"] < c.ours["exact"] < c.ours["general"] < c.reference.ce_aba for c in rows)


def test_writes_pictures_and_tables(without_loops, tmp_path):
    pytest.importorskip("matplotlib")
    arguments = argparse.Namespace(out=tmp_path / "new", branches=[1, 2], depth=3, chain_depths=[10])
    report = paper.run(arguments)
    written = {path.name for path in (tmp_path / "new").iterdir()}
    pictures = {"depth_link_and_rotor.png", "depth_belt_pair.png", "locality.png", "approximation.png", "tracking.png"}
    assert written == pictures | {"depth.csv", "locality.csv", "approximation.csv", "tracking.csv"}
    with (tmp_path / "new" / "depth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    assert (rows[0]["chain"], rows[0]["ce_aba"]) == ("link_and_rotor", "641")
    assert 0 < int(rows[0]["ours_exact"]) < 641
    assert sum(1 for _ in (tmp_path / "new" / "tracking.csv").open()) == 10002
    locality = next(table for table in report.tables if table.title.startswith("Locality"))
    ours, library = (float(str(cell)) for cell in locality.rows[0][2:])
    assert ours > 2 * library
