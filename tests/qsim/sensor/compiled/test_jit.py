"""Pieces of kernels: random words, the exponential, and processes that cannot use Dr.Jit."""

import subprocess
import sys
from math import log

import numpy as np
import pytest
from compiled_cases import KEY, needs_engine

from qsim.keys import philox4x32
from qsim.sensor.compiled import jit


@needs_engine
def test_the_compiled_generator_gives_the_same_words():
    drjit = jit.backend()
    counters = np.random.default_rng(0).integers(0, 2**32, (3, 1000), dtype=np.uint32)
    key = KEY.philox_key
    words = jit.philox(*(drjit.UInt32(c) for c in counters), drjit.UInt32(key >> 32), drjit.UInt32(key & 0xFFFFFFFF))
    expected = philox4x32(np.vstack([counters, np.zeros((1, 1000), np.uint32)]), key)
    np.testing.assert_array_equal(np.stack([w.numpy() for w in words]), expected)


@needs_engine
def test_the_short_exponential_is_exact_to_float32():
    """Within 2 units in the last place of float32 of exp, over all that a live time can be."""
    drjit = jit.backend()
    x = -np.concatenate([np.geomspace(1e-12, 87, 200_000), np.arange(0, 87, 1 / 64), [0, log(2) / 2]]).astype(
        np.float32
    )
    found = jit.exp_below_zero(drjit.Float(x)).numpy()
    error = found / np.exp(x.astype(np.float64)) - 1
    assert np.abs(error).max() < 2.4e-7
    assert found[x == 0][0] == 1


FORK = """
import os, sys, warnings
import numpy as np
from qsim.sensor.compiled import jit
from qsim.keys import Key
from qsim.sensor.qis import QIS
sensor, photons = QIS(0.8, 1.6, 0.2, 3), np.full((1, 128, 128), 2.0, np.float32)
def draw():
    return sensor.sample(photons, 5e-4, key=Key(1, 2))
before = draw()
warnings.simplefilter("ignore")  # Python warns of forks while other threads run
child = os.fork()
if child == 0:
    os._exit(0 if (draw() == before).all() and not jit.available() else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@needs_engine
@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="no fork on this system")
def test_a_forked_child_draws_the_same_codes_without_the_threads_it_lost():
    done = subprocess.run([sys.executable, "-c", FORK], timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
