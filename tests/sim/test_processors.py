"""The same numbers on another kind of processor: a kernel compiled for one with other vectors, run by this one."""

import os
import platform
import subprocess
import sys

import pytest
from tripod import TRIPOD

SCRIPT = """
import hashlib, itertools
import numpy as np
import ce_gym
from ce_gym.compile import machine_code

if {cpu!r}:
    machine_code.host_cpu = lambda: ({cpu!r}, "")
for robot, dtype in itertools.product(({tripod!r}, "six_bar"), ("float64", "float32")):
    model = ce_gym.Model(robot)
    sim = ce_gym.Simulator(model, 21, dtype=dtype)
    joints, rng = len(model.joint_links), np.random.default_rng(0)
    for _ in range(50):
        sim.step(model.standing_q[-joints:] + 0.3 * rng.normal(size=(21, joints)), n_substeps=2)
    assert sim.n_diverged == 0
    print(hashlib.sha256(np.ascontiguousarray(sim.q).tobytes() + np.ascontiguousarray(sim.v).tobytes()).hexdigest())
"""

HASWELL = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
"""Makes numpy and its linear algebra compute as on a processor of 2013."""


def hashes(folder, cpu="", **environment):
    """Output of the script in a process of its own: one line for each robot and type."""
    given = os.environ | {"CE_GYM_CACHE_DIR": str(folder)} | environment
    code = SCRIPT.format(tripod=TRIPOD, cpu=cpu)
    done = subprocess.run([sys.executable, "-c", code], env=given, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="compiles for a processor of 2013, x86-64")
def test_short_vectors_give_the_numbers_of_long_ones(tmp_path):
    """A hundred sub-steps with contacts, by AVX2 as by what this processor has (AVX-512, where the test says most)."""
    here = hashes(tmp_path / "here")
    assert len(set(here)) == 4
    assert hashes(tmp_path / "haswell", "haswell", **HASWELL) == here
