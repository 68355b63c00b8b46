"""The compiled engine draws the reference's codes: every model, crop, depth and light, packed or not."""

import re
import subprocess
import sys
from dataclasses import replace
from math import log

import numpy as np
import pytest
from stats import assert_histogram

from qsim.keys import Key, philox4x32
from qsim.sensor.compiled import kernel, launch
from qsim.sensor.compiled.curves import Curves
from qsim.sensor.compiled.plan import Electrons, electrons, plan
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.packing import pack
from qsim.sensor.pixels import draw_at
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

KEY = Key(seed=3, clip=5, frame=7)
EXPOSURE = 5e-4  # s
needs_engine = pytest.mark.skipif(not kernel.available(), reason="no usable LLVM or CUDA on this machine")

SENSORS: dict[str, Sensor] = {
    "3 bits, gain 1": QIS(0.8, 1.6, 0.2, 3),
    "published gain": QIS(0.8, 3200.0, 0.2, 3, gain=0.5 * 7 / 3.25),
    "low gain": QIS(0.8, 1.6, 0.2, 3, gain=0.1346),
    "no read noise": QIS(0.8, 1.6, 0.0, 3),
    "one bit": QIS(0.8, 1.6, 0.2, 1),
    "five bits": QIS(0.8, 1.6, 0.2, 5),
    "full well": QIS(0.8, 1.6, 0.2, 3, full_well=4.0),
    "one plane": BinarySPAD(0.5, 10.0),
    "seven planes": BinarySPAD(0.5, 10.0, 3),
    "dead time": CountingSPAD(0.5, 100.0, 1e-4, 3),
    "four-bit counter": CountingSPAD(0.5, 100.0, 1e-6, 4),
}
SHORT = tuple(SENSORS)  # their steps are sums
SENSORS |= {  # steps that are looked up
    "noisy, with offset": QIS(0.8, 1.6, 5.1, 3, gain=0.3, offset=2.0),
    "long sums": QIS(0.8, 1.6, 0.3, 5, gain=0.3),
    "long sums without noise": QIS(0.8, 1.6, 0.0, 8, gain=0.02),
    "longer sums and full well": QIS(0.8, 1.6, 3.0, 7, gain=0.0085, offset=-20.0, full_well=9000.5),
    "much noise": QIS(0.8, 1.6, 9.0, 8),
    "eight-bit counter": CountingSPAD(0.5, 100.0, 3e-6, 8),
    "paralyzable": CountingSPAD(0.5, 100.0, 1e-4, 3, paralyzable=True),
    "paralyzable, six bits": CountingSPAD(0.5, 100.0, 4e-6, 6, paralyzable=True),
}
# Where no kernel serves
OTHERS: dict[str, Sensor] = {
    "ten bits": QIS(0.8, 1.6, 5.1, 10, offset=32.0),
    "nine-bit counter": CountingSPAD(0.5, 100.0, 1e-7, 9),
}


def light(sensor: Sensor, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Photons from dark to twice white, float32."""
    top = 2 * sensor.white(EXPOSURE)
    return np.random.default_rng(seed).uniform(0, top, shape).astype(np.float32)


def fast(sensor: Sensor, photons: np.ndarray, **settings: object) -> np.ndarray:
    return launch.sample(sensor, photons, EXPOSURE, **({"key": KEY, "smallest": 1} | settings))


def reference(sensor: Sensor, photons: np.ndarray, **settings: object) -> np.ndarray:
    return sensor.sample(photons, EXPOSURE, **({"key": KEY} | settings), engine="reference")


# ---- The sums


@pytest.mark.parametrize("name", [name for name in SHORT if isinstance(SENSORS[name], QIS)])
def test_the_sums_are_the_cdf(name):
    """Evaluated in float64 they differ by the coefficients left out (1e-12) and by rounding."""
    sensor = SENSORS[name]
    steps = electrons(sensor)
    assert isinstance(steps, Electrons)
    mean = np.minimum(np.linspace(0, 1.2 * steps.highest, 200), steps.highest)[:, None]
    terms = (mean / steps.scale) ** np.arange(len(steps.full))
    for k, (prefix, band, floor) in enumerate(zip(steps.prefix, steps.band, steps.floor, strict=True)):
        total = terms[:, :prefix] @ steps.full[:prefix] + terms[:, prefix : prefix + len(band)] @ band
        step = floor + total * np.exp(-mean[:, 0])
        np.testing.assert_allclose(step, sensor._cdf(mean[:, 0], EXPOSURE)[:, k], atol=1e-10)


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in SHORT])
def test_curves_are_the_cdf(name):
    """At random light, dark to beyond the last step, to half of their margin: their error and float32's rounding."""
    sensor = SENSORS[name]
    whole = plan(sensor, EXPOSURE)
    assert isinstance(whole.steps, Curves)
    brightest = min(1.5 * sensor.white(EXPOSURE), 0.98 * whole.steps.brightest**2 / sensor.efficiency)
    photons = np.random.default_rng(1).uniform(0, brightest, 500).astype(np.float32)
    at = (np.sqrt(sensor.arrivals(photons, EXPOSURE))[:, None] - whole.steps.start) * whole.steps.rate
    cells = whole.steps.cubics.shape[1]
    at = np.clip(at, 0, cells)
    cell = np.minimum(at.astype(int), cells - 1)
    cubic = whole.steps.cubics[np.arange(len(whole.steps.rate)), cell].astype(float)
    found = (cubic * (at - cell)[..., None] ** np.arange(4)).sum(axis=-1)
    np.testing.assert_allclose(found, sensor.cdf(photons, EXPOSURE)[:, :-1], rtol=0, atol=whole.margin / 2)


@pytest.mark.parametrize("name", OTHERS)
def test_more_than_eight_bits_have_no_plan(name):
    assert plan(OTHERS[name], EXPOSURE) is None


# ---- The same codes


@needs_engine
def test_the_compiled_generator_gives_the_same_words():
    jit = kernel.backend()
    counters = np.random.default_rng(0).integers(0, 2**32, (3, 1000), dtype=np.uint32)
    key = KEY.philox_key
    words = kernel._philox(*(jit.UInt32(c) for c in counters), jit.UInt32(key >> 32), jit.UInt32(key & 0xFFFFFFFF))
    expected = philox4x32(np.vstack([counters, np.zeros((1, 1000), np.uint32)]), key)
    np.testing.assert_array_equal(np.stack([w.numpy() for w in words]), expected)


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize(("shape", "origin"), [((2, 9, 13), (3, 5)), ((1, 40, 64), (0, 0)), ((3, 7, 10), (2, 8))])
def test_codes_equal_the_reference_packed_or_not(name, shape, origin):
    sensor = SENSORS[name]
    photons = light(sensor, shape)
    expected = reference(sensor, photons, origin=origin)
    np.testing.assert_array_equal(fast(sensor, photons, origin=origin), expected, strict=True)
    packed = launch.sample_packed(sensor, photons, EXPOSURE, key=KEY, origin=origin, smallest=1)
    np.testing.assert_array_equal(packed, pack(expected, sensor.bits), strict=True)


@needs_engine
@pytest.mark.parametrize("name", ["3 bits, gain 1", "low gain", "one plane", "dead time"])
def test_a_quarter_of_a_million_pixels_are_all_the_same(name):
    sensor = SENSORS[name]
    photons = light(sensor, (2, 256, 511), seed=1)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_two_million_pixels_are_all_the_same(name):
    sensor = SENSORS[name]
    photons = light(sensor, (8, 512, 512), seed=2)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
def test_float32_alone_stays_well_within_its_margin(name, monkeypatch):
    """With a quarter of the margin nothing changes; with none a few pixels in a million differ."""
    sensor = SENSORS[name]
    photons = light(sensor, (2, 300, 500), seed=3)
    expected = fast(sensor, photons)
    whole = plan(sensor, EXPOSURE)
    monkeypatch.setattr(launch, "plan", lambda *_: replace(whole, margin=whole.margin / 4))
    np.testing.assert_array_equal(fast(sensor, photons), expected)
    monkeypatch.setattr(launch, "plan", lambda *_: replace(whole, margin=0.0))
    assert (fast(sensor, photons) != expected).mean() <= 2e-5


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
def test_extreme_light_has_the_reference_codes(name):
    sensor = SENSORS[name]
    levels = [0.0, 1e-300, 1e-12, 1e-6, 1e-3, 87.0, 88.8, 130.0, 1e3, 1e6, 1e12, 1e30, 1e39, 1e200]
    photons = np.repeat(np.array(levels)[:, None], 64, axis=1)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.parametrize("terms", [48, 58, 59, 62, 65, 68, 71, 75, 76, 104])
def test_dark_pixels_of_long_sums_are_drawn_right(terms):
    """At a few electrons the last terms are tiny and still decide; 59 to 75 terms once lost them and drew the top."""
    sensor = QIS(0.8, 1.6, 0.2, 1, gain=0.5 / terms)
    photons = np.repeat([0.1, 0.5, 2.4, 6.0, 15.0], 8192).reshape(5, 64, 128)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.parametrize("bits", range(1, 9))
def test_packing_at_every_width_and_depth(bits):
    sensor = QIS(0.8, 1.6, 0.2, bits)
    for width in (1, 2, 3, 5, 8, 9, 16, 31, 70) if bits < 6 else (3, 31):
        photons = light(sensor, (2, 3, width), seed=width)
        packed = launch.sample_packed(sensor, photons, EXPOSURE, key=KEY, smallest=1)
        np.testing.assert_array_equal(packed, pack(reference(sensor, photons), bits), strict=True)


@needs_engine
@pytest.mark.parametrize("width", range(1, 71))
def test_one_bit_planes_of_every_width(width):
    sensor = BinarySPAD(0.5, 1000.0)
    photons = light(sensor, (1, 2, width))
    packed = launch.sample_packed(sensor, photons, EXPOSURE, key=KEY, smallest=1)
    np.testing.assert_array_equal(packed, np.packbits(reference(sensor, photons), axis=-1), strict=True)


@needs_engine
def test_layout_and_type_of_the_photons_do_not_matter():
    sensor = SENSORS["3 bits, gain 1"]
    photons = light(sensor, (4, 16, 24))
    expected = fast(sensor, photons)
    for other in (photons.astype(float), photons.astype(">f4"), np.asfortranarray(photons), photons.astype(np.float16)):
        given = fast(sensor, other)
        np.testing.assert_array_equal(given, reference(sensor, other))
        if other.dtype != np.float16:
            np.testing.assert_array_equal(given, expected)
    np.testing.assert_array_equal(fast(sensor, photons[::2, ::-1, 3:20]), reference(sensor, photons[::2, ::-1, 3:20]))
    np.testing.assert_array_equal(fast(sensor, np.full((2, 8, 8), 3)), reference(sensor, np.full((2, 8, 8), 3.0)))


@needs_engine
@pytest.mark.parametrize("draw", [launch.sample, launch.sample_packed])
def test_frames_can_be_drawn_in_any_order(draw):
    sensor = SENSORS["seven planes"]
    photons = np.broadcast_to(light(sensor, (1, 9, 16)), (5, 9, 16))
    whole = draw(sensor, photons, EXPOSURE, key=KEY, smallest=1)
    for t in (4, 0, 2):
        alone = draw(sensor, photons[t], EXPOSURE, key=KEY.at(KEY.frame + t), smallest=1)
        np.testing.assert_array_equal(alone, whole[t])
    assert len({frame.tobytes() for frame in whole}) == 5


@needs_engine
@pytest.mark.parametrize("largest", [1, 40, 100])
def test_large_frames_are_drawn_in_strips(largest, monkeypatch):
    """Launches of a row or a few each, with a last one that is shorter: the same codes, packed or not."""
    sensor = SENSORS["low gain"]
    photons = light(sensor, (2, 11, 20))
    monkeypatch.setattr(launch, "_LARGEST", largest)
    expected = reference(sensor, photons, origin=(3, 8))
    np.testing.assert_array_equal(fast(sensor, photons, origin=(3, 8)), expected)
    packed = launch.sample_packed(sensor, photons, EXPOSURE, key=KEY, origin=(3, 8), smallest=1)
    np.testing.assert_array_equal(packed, pack(expected, sensor.bits))


@needs_engine
def test_the_short_exponential_is_exact_to_float32():
    """Within 2 units in the last place of float32 of exp, over all that a live time can be."""
    jit = kernel.backend()
    x = -np.concatenate([np.geomspace(1e-12, 87, 200_000), np.arange(0, 87, 1 / 64), [0, log(2) / 2]]).astype(
        np.float32
    )
    found = kernel._exp_below_zero(jit.Float(x)).numpy()
    error = found / np.exp(x.astype(np.float64)) - 1
    assert np.abs(error).max() < 2.4e-7
    assert found[x == 0][0] == 1


@needs_engine
def test_sensors_share_kernels_after_the_first_few(monkeypatch):
    """Numbers as arguments of a common kernel instead of constants: the same codes."""
    monkeypatch.setattr(kernel, "_CONSTANT_PLANS", 0)
    kernel._arguments.cache_clear()
    for name in ("published gain", "full well", "dead time", "seven planes"):
        sensor = SENSORS[name]
        photons = light(sensor, (2, 20, 30))
        np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))
    kernel._arguments.cache_clear()


@needs_engine
def test_the_drawn_codes_follow_the_closed_form():
    sensor = SENSORS["published gain"]
    codes = fast(sensor, np.full((1, 300, 400), 3.25, np.float32))
    assert_histogram(codes, np.exp(sensor.log_pmf(np.array(3.25), EXPOSURE)))


# ---- Around the kernel


@pytest.mark.parametrize("name", OTHERS)
def test_other_sensors_are_drawn_by_the_reference(name):
    sensor = OTHERS[name]
    photons = light(sensor, (2, 5, 7))
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons), strict=True)
    packed = launch.sample_packed(sensor, photons, EXPOSURE, key=KEY, smallest=1)
    np.testing.assert_array_equal(packed, pack(reference(sensor, photons), sensor.bits))


@needs_engine
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1e-3, -np.inf])
def test_what_is_no_light_level_is_named(wrong):
    photons = np.ones((2, 8, 10))
    photons[1, 2, 3] = wrong
    text = re.escape(f"photons[1, 2, 3] is {wrong}")
    for draw in (launch.sample, launch.sample_packed):
        with pytest.raises(ValueError, match=text):
            draw(SENSORS["3 bits, gain 1"], photons, EXPOSURE, key=KEY, smallest=1)


def test_empty_stacks_stay_empty():
    sensor = SENSORS["3 bits, gain 1"]
    assert fast(sensor, np.zeros((0, 4, 5))).shape == (0, 4, 5)
    assert launch.sample_packed(sensor, np.zeros((2, 0, 5)), EXPOSURE, key=KEY).shape == (2, 0, 2)


@pytest.mark.parametrize("name", SENSORS)
def test_single_pixels_are_those_of_the_frame(name):
    sensor = SENSORS[name]
    photons = light(sensor, (3, 6, 9))
    at = np.array([[0, 2, 2, 1], [5, 0, 3, 3], [8, 0, 4, 4]])
    expected = reference(sensor, photons, origin=(2, 3))[tuple(at)]
    np.testing.assert_array_equal(draw_at(sensor, photons, EXPOSURE, KEY, (2, 3), at), expected)


MEMORY = """
import os, tracemalloc
import numpy as np
from qsim.sensor.compiled import launch as kernels
from qsim.keys import Key
from qsim.sensor.qis import QIS
sensor, photons = QIS(0.8, 1.6, 0.2, 3), np.full((40, 256, 255), 2.0)
kernels._LARGEST = photons[0].size  # a launch per frame, as for frames of a million pixels
for draw in (kernels.sample, kernels.sample_packed):
    draw(sensor, photons[:2], 5e-4, key=Key(1, 2))
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    codes = draw(sensor, photons, 5e-4, key=Key(1, 2))
    print((tracemalloc.get_traced_memory()[1] - before - codes.nbytes) / photons[0].size, flush=True)
    del codes
os._exit(0)
"""


@needs_engine
def test_memory_is_the_output_and_what_launches_hold():
    """Bytes per pixel of a launch, beyond the codes: the 13 of kernels.py, and 3 for finishing (2 to 8 seen).

    40 frames in float64: their float32 would be 160 bytes, their codes once more 40, or 15 packed. In a process of its
    own, which never stops tracing: in Python 3.11 that crashes while another thread, here Dr.Jit's that lets go of an
    array, waits for the interpreter (python/cpython issue 128679).
    """
    line = [sys.executable, "-X", "tracemalloc", "-c", MEMORY]
    done = subprocess.run(line, timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    held = [float(number) for number in done.stdout.split()]
    assert len(held) == 2
    assert max(held) < 16, held


ODD = """
import os, sys
import numpy as np
from qsim.sensor.compiled import launch as kernels
from qsim.keys import Key
from qsim.sensor.spad import BinarySPAD
for kind in (np.float32, np.float64):
    photons = np.full((65535, 2, 4), 0.5, kind)
    for draw in (kernels.sample, kernels.sample_packed):
        draw(BinarySPAD(0.5, 10.0), photons, 5e-4, key=Key(1, 2))
os._exit(0)
"""


@needs_engine
def test_no_kernel_reads_beyond_its_light():
    """32 bytes below two mebibytes: the last packet reached into a page that is not there, and the process ended."""
    done = subprocess.run([sys.executable, "-c", ODD], timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


FORK = """
import os, sys, warnings
import numpy as np
from qsim.sensor.compiled import launch as kernels; from qsim.sensor.compiled import kernel as lanes
from qsim.keys import Key
from qsim.sensor.qis import QIS
sensor, photons = QIS(0.8, 1.6, 0.2, 3), np.full((1, 128, 128), 2.0, np.float32)
def draw():
    return sensor.sample(photons, 5e-4, key=Key(1, 2))
before = draw()
warnings.simplefilter("ignore")  # Python warns of forks while other threads run
child = os.fork()
if child == 0:
    os._exit(0 if (draw() == before).all() and not lanes.available() else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@needs_engine
@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="no fork on this system")
def test_a_forked_child_draws_the_same_codes_without_the_threads_it_lost():
    done = subprocess.run([sys.executable, "-c", FORK], timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
