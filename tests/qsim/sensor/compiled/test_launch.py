"""The compiled engine draws the reference's codes: every model, crop, depth and layout, packed or not."""

import re
import subprocess
import sys

import numpy as np
import pytest
from compiled_cases import EXPOSURE, KEY, OTHERS, SENSORS, fast, fast_packed, light, needs_engine, reference
from hypothesis import given, settings
from hypothesis import strategies as st

from qsim.keys import Key
from qsim.sensor.compiled import launch
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.packing import pack
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize(("shape", "origin"), [((2, 9, 13), (3, 5)), ((1, 40, 64), (0, 0)), ((3, 7, 10), (2, 8))])
def test_codes_equal_the_reference_packed_or_not(name, shape, origin):
    sensor = SENSORS[name]
    photons = light(sensor, shape)
    expected = reference(sensor, photons, origin=origin)
    np.testing.assert_array_equal(fast(sensor, photons, origin=origin), expected, strict=True)
    packed = fast_packed(sensor, photons, origin)
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
@pytest.mark.parametrize("bits", range(1, 9))
def test_packing_at_every_width_and_depth(bits):
    sensor = QIS(0.8, 1.6, 0.2, bits)
    for width in (1, 2, 3, 5, 8, 9, 16, 31, 70) if bits < 6 else (3, 31):
        photons = light(sensor, (2, 3, width), seed=width)
        packed = fast_packed(sensor, photons)
        np.testing.assert_array_equal(packed, pack(reference(sensor, photons), bits), strict=True)


@needs_engine
@pytest.mark.parametrize("width", range(1, 71))
def test_one_bit_planes_of_every_width(width):
    sensor = BinarySPAD(0.5, 1000.0)
    photons = light(sensor, (1, 2, width))
    packed = fast_packed(sensor, photons)
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
@pytest.mark.parametrize("draw", [fast, fast_packed])
def test_frames_can_be_drawn_in_any_order(draw):
    sensor = SENSORS["seven planes"]
    photons = np.broadcast_to(light(sensor, (1, 9, 16)), (5, 9, 16))
    whole = draw(sensor, photons)
    for t in (4, 0, 2):
        alone = draw(sensor, photons[t], key=KEY.at(KEY.frame + t))
        np.testing.assert_array_equal(alone, whole[t])
    assert len({frame.tobytes() for frame in whole}) == 5


@needs_engine
@pytest.mark.parametrize("largest", [1, 40, 100])
def test_large_frames_are_drawn_in_strips(largest, monkeypatch):
    """Launches of a row or a few each, with a last one that is shorter: the same codes, packed or not."""
    sensor = SENSORS["low gain"]
    photons = light(sensor, (2, 11, 20))
    monkeypatch.setattr(launch, "LARGEST", largest)
    expected = reference(sensor, photons, origin=(3, 8))
    np.testing.assert_array_equal(fast(sensor, photons, origin=(3, 8)), expected)
    packed = fast_packed(sensor, photons, (3, 8))
    np.testing.assert_array_equal(packed, pack(expected, sensor.bits))


# ---- Around the kernel


@pytest.mark.parametrize("name", OTHERS)
def test_other_sensors_are_drawn_by_the_reference(name):
    sensor = OTHERS[name]
    photons = light(sensor, (2, 5, 7))
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons), strict=True)
    packed = fast_packed(sensor, photons)
    np.testing.assert_array_equal(packed, pack(reference(sensor, photons), sensor.bits))


@needs_engine
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1e-3, -np.inf])
def test_what_is_no_light_level_is_named(wrong):
    photons = np.ones((2, 8, 10))
    photons[1, 2, 3] = wrong
    text = re.escape(f"photons[1, 2, 3] is {wrong}")
    for draw in (fast, fast_packed):
        with pytest.raises(ValueError, match=text):
            draw(SENSORS["3 bits, gain 1"], photons)


def test_empty_stacks_stay_empty():
    sensor = SENSORS["3 bits, gain 1"]
    assert fast(sensor, np.zeros((0, 4, 5))).shape == (0, 4, 5)
    assert fast_packed(sensor, np.zeros((2, 0, 5))).shape == (2, 0, 2)


@pytest.mark.parametrize("name", SENSORS)
def test_single_pixels_are_those_of_the_frame(name):
    sensor = SENSORS[name]
    photons = light(sensor, (3, 6, 9))
    at = np.array([[0, 2, 2, 1], [5, 0, 3, 3], [8, 0, 4, 4]])
    expected = reference(sensor, photons, origin=(2, 3))[tuple(at)]
    place = at + np.array([[KEY.frame], [2], [3]])
    np.testing.assert_array_equal(sensor.draw_at(photons[tuple(at)], EXPOSURE, key=KEY, at=place), expected)


MEMORY = """
import os, tracemalloc
import numpy as np
from qsim.keys import Key
from qsim.sensor.compiled import launch
from qsim.sensor.counting import CountingSPAD
from qsim.keys import Key
from qsim.sensor.qis import QIS
sensor, photons = QIS(0.8, 1.6, 0.2, 3), np.full((40, 256, 255), 2.0)
launch.LARGEST = photons[0].size  # a launch per frame, as for frames of a million pixels
for draw in (sensor.sample, sensor.sample_packed):
    draw(photons[:2], 5e-4, key=Key(1, 2))
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    codes = draw(photons, 5e-4, key=Key(1, 2))
    print((tracemalloc.get_traced_memory()[1] - before - codes.nbytes) / photons[0].size, flush=True)
    del codes
os._exit(0)
"""


@needs_engine
def test_memory_is_the_output_and_what_launches_hold():
    """Bytes per pixel of a launch, beyond the codes: the 13 of launch.py, and 3 for finishing (2 to 8 seen).

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
from qsim.keys import Key
from qsim.sensor.spad import BinarySPAD
for kind in (np.float32, np.float64):
    photons = np.full((65535, 2, 4), 0.5, kind)
    for draw in (BinarySPAD.sample, BinarySPAD.sample_packed):
        draw(BinarySPAD(0.5, 10.0), photons, 5e-4, key=Key(1, 2))
os._exit(0)
"""


@needs_engine
def test_no_kernel_reads_beyond_its_light():
    """32 bytes below two mebibytes: the last packet reached into a missing page, which ended the process."""
    done = subprocess.run([sys.executable, "-c", ODD], timeout=120, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ---- The counters of random numbers end


def _outcome(draw, *arguments, **options) -> str | list[int]:
    """Codes as numbers, or the sentence of the refusal."""
    try:
        return np.asarray(draw(*arguments, **options)).ravel().tolist()
    except ValueError as error:
        return str(error)


LIMIT = 1 << 32


COUNTED_BY = [
    *(BinarySPAD(0.4, 20.0, bits) for bits in (1, 3, 8, 9, 16)),  # up to 8 bits a counter per plane
    QIS(0.8, 1.6, 0.2, 3),
    QIS(0.8, 1.6, 0.2, 12),
    CountingSPAD(0.5, 100.0, 1e-6, 4),
    CountingSPAD(0.5, 100.0, 1e-6, 12),
]
CASES = [(sensor, LIMIT // sensor.counters) for sensor in COUNTED_BY]


def _near(end: int, farthest: int) -> st.SearchStrategy[int]:
    """At the beginning, around the end, or anywhere."""
    return st.one_of(st.integers(0, 9), st.integers(end - 9, end + 2), st.integers(-3, farthest))


@needs_engine
@settings(max_examples=100, deadline=None)
@given(
    case=st.sampled_from(CASES).flatmap(lambda case: st.tuples(st.just(case[0]), _near(case[1], 1 << 40))),
    row=_near(LIMIT, 1 << 33),
    column=_near(LIMIT, 1 << 33),
)
def test_both_engines_end_at_the_same_frame_row_and_column(case, row, column):
    """They draw the same codes or refuse by the same sentence: the compiled counters of 32 bits began again at 0."""
    sensor, frame = case
    frames = 2
    if not 0 <= frame < LIMIT:
        with pytest.raises(ValueError, match=r"^Key\.frame counts frames"):
            Key(1, 2, frame=frame)
        return
    photons = light(sensor, (frames, 2, 3))
    where = {"key": Key(1, 2, frame=frame), "origin": (row, column)}
    expected = _outcome(sensor.sample, photons, EXPOSURE, engine="reference", **where)
    assert _outcome(sensor.sample, photons, EXPOSURE, engine="fast", **where) == expected
    packed = _outcome(sensor.sample_packed, photons, EXPOSURE, engine="fast", **where)
    assert packed == _outcome(sensor.sample_packed, photons, EXPOSURE, engine="reference", **where)
    if isinstance(expected, str):
        assert expected == packed == _outcome(sensor.sample_on_device, photons, EXPOSURE, **where)
    inside = (frame + frames) * sensor.counters <= LIMIT and min(row, column) >= 0 and max(row + 2, column + 3) <= LIMIT
    assert isinstance(expected, list) == inside


@needs_engine
def test_planes_of_a_clip_end_at_the_same_plane():
    sensor = BinarySPAD(0.4, 20.0, 3)
    photons = light(sensor, (7, 2, 3))
    last = LIMIT // 7 - 1
    drawn = [sensor.sample_planes(photons, EXPOSURE, key=Key(1, 2, last), engine=e) for e in ("fast", "reference")]
    np.testing.assert_array_equal(*drawn)
    for engine in ("fast", "reference"):
        with pytest.raises(ValueError, match=r"^planes \(7 per frame\) 4294967292 to 4294967298: random numbers have"):
            sensor.sample_planes(photons, EXPOSURE, key=Key(1, 2, last + 1), engine=engine)


@needs_engine
@pytest.mark.parametrize("origin", [(-1, 0), (0, -1), (0.5, 0), (1,), None])
def test_an_origin_outside_of_the_frame_is_refused(origin):
    photons = np.ones((2, 3))
    for engine in ("fast", "reference"):
        with pytest.raises(ValueError, match=r"^(rows -1 to 0|columns -1 to 1|origin is a row and a column)"):
            BinarySPAD(0.4, 20.0).sample(photons, EXPOSURE, key=KEY, origin=origin, engine=engine)
