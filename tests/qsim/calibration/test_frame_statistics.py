"""Statistics of frames: block by block, of sums of planes, and refused values."""

import numpy as np
import pytest
from synthetic import PLANE

from qsim.calibration.frame_statistics import measure, measure_sums
from qsim.calibration.qis import calibrate_qis
from qsim.calibration.spad import calibrate_spad

H, W = PLANE


def test_blocks_do_not_matter():
    codes = np.random.default_rng(0).integers(0, 8, (11, 5, 7))
    whole = measure([codes], bits=3, exposure=1e-3, photons=None)
    parts = measure([codes[:1], codes[1:4], codes[4], codes[5:]], bits=3, exposure=1e-3, photons=None)
    for name in ("total", "square", "lagged", "histogram"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert whole.frames == parts.frames == 11
    assert whole.variance == pytest.approx(codes.var(axis=0, ddof=1).mean())
    centred = codes - codes.mean(axis=0)
    lag = (centred[1:] * centred[:-1]).sum(axis=0) / 10
    assert whole.lag_covariance == pytest.approx(lag.mean() + whole.variance / 11)


def test_float_frames_are_taken_if_whole():
    codes = np.random.default_rng(0).integers(0, 8, (3, 4, 5))
    assert np.array_equal(
        measure([codes.astype(np.float32)], bits=3, exposure=1.0, photons=0.0).total, codes.sum(axis=0)
    )
    with pytest.raises(ValueError, match=r"dark.npy: 0.5 at \(t, y, x\) = \(0, 0, 0\) is not a code of 3 bits"):
        measure([np.full((1, 2, 2), 0.5, np.float32)], bits=3, exposure=1.0, photons=0.0, name="dark.npy")


def test_a_million_frames_take_no_more_memory():
    """The same block a thousand times: the stored sums do not grow."""
    block = np.random.default_rng(0).integers(0, 2, (1000, 2, 3)).astype(bool)
    stack = measure((block for _ in range(1000)), bits=1, exposure=1e-5, photons=None)
    assert stack.frames == 1_000_000
    assert stack.mean == pytest.approx(block.mean())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposure": 0.0}, "exposure is in seconds and above 0"),
        ({"photons": -1.0}, "photons are a number of at least 0"),
    ],
)
def test_impossible_stacks_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        measure([np.zeros((2, 2, 2), int)], **({"bits": 3, "exposure": 1.0, "photons": 0.0} | change))


def test_one_frame_of_sums_is_enough():
    ones = np.random.default_rng(0).binomial(4096, 0.3, (H, W))
    one = measure_sums([ones], planes=4096, exposure=1e-5, photons=None)
    assert np.array_equal(one.total, ones)
    assert one.frames == 4096
    assert one.histogram.tolist() == [4096 * ones.size - ones.sum(), ones.sum()]


def test_values_above_the_planes_name_their_place():
    with pytest.raises(ValueError, match=r"5 at \(t, y, x\) = \(1, 0, 0\) is not a sum of 4 planes, 0..4"):
        measure_sums([np.zeros((1, H, W), int), np.full((1, H, W), 5)], planes=4, exposure=1e-5, photons=None)
    with pytest.raises(ValueError, match="sums of N binary planes are calibrated with summed=N"):
        measure([np.full((1, H, W), 19)], bits=1, exposure=1e-5, photons=None)


def test_stacks_of_other_bits_are_refused():
    """Eight bits calibrated as one gave a wrong efficiency, without an error."""
    frames = np.random.default_rng(0).integers(0, 200, (4, 6, 7))
    stacks = [measure(frames, bits=8, exposure=1e-3, photons=photons) for photons in (0.0, 50.0)]
    for calibrate, bits in ((calibrate_spad, 1), (calibrate_qis, 10)):
        with pytest.raises(ValueError, match=f"bits={bits}, and a stack was measured with bits=8; give both the same"):
            calibrate(stacks[:1], stacks[1:], bits=bits)


def test_products_of_neighbours_are_summed_over_frames():
    """In blocks of any length."""
    codes = np.random.default_rng(4).integers(0, 8, (9, 5, 6))
    found = measure([codes[:2], codes[2:]], bits=3, exposure=1e-3, photons=0.0)
    below = (codes[:, 1:] * codes[:, :-1]).sum(axis=0)
    right = (codes[:, :, 1:] * codes[:, :, :-1]).sum(axis=0)
    assert np.array_equal(found.adjacent[0, :-1], below)
    assert np.array_equal(found.adjacent[1, :, :-1], right)
    assert not found.adjacent[0, -1].any()
    assert not found.adjacent[1, :, -1].any()
