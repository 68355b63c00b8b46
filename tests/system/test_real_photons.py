"""The models against measured photons and dark counts; expectations come from the data's description.

Hazelnut: photon counts of a static object in a scanning microscope, five scans of 6 time gates (BSD-3).
The two SPAD files may not be in the repository: they are read from ../shared/data, and skipped where that is absent.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.stats import ks_2samp
from stats import assert_share, critical_z

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.event_simulation import Memory, simulate
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern, Maps, draw_maps, measured_dark_map
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.qis import QIS

HERE = Path(__file__)
SHARED = HERE.parents[3] / "shared" / "data"
PIXEL_TIME = 6.33e-6  # s, of the hazelnut scan
DEAD_TIME = 4.0e-9  # s, effective, as fitted on the same detector's upper classes; +- 0.3 ns
ideal = CountingSPAD(1.0, 0.0, 0.0, 3)


@pytest.fixture(scope="module")
def gates() -> np.ndarray:
    """Photon counts [5 scans, 6 gates, 256, 256]."""
    return np.load(HERE.parents[1] / "data" / "hazelnut_gates6.npz")["gates"]


@pytest.fixture(scope="module")
def counts(gates: np.ndarray) -> np.ndarray:
    """Photon counts per scan [5, 256, 256]."""
    return gates.sum(axis=1, dtype=np.int64)


def shared(name: str) -> np.ndarray:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{path} is not here: this measurement may not be copied into the repository")
    return np.load(path)


def fano(repeats: np.ndarray, low: float, high: float) -> tuple[float, float, float]:
    """Variance over mean of pixels whose own mean is in a class, its standard error, the class mean.

    Given a pixel's total, the mean of s^2 is the mean count, if Poisson: the class selects nothing. The error is that
    of s^2 of n Poisson repeats, (mu4 - var^2 (n-3)/(n-1)) / n with mu4 = m + 3 m^2.
    """
    n = len(repeats)
    mean = repeats.mean(axis=0)
    chosen = (mean >= low) & (mean < high)
    m = mean[chosen]
    variance = repeats[:, chosen].var(axis=0, ddof=1)
    error = np.sqrt(((m + 3 * m**2 - m**2 * (n - 3) / (n - 1)) / n).sum())
    return float(variance.sum() / m.sum()), float(error / m.sum()), float(m.mean())


def test_the_data_are_the_described_ones(gates, counts):
    assert counts.sum() == 6_065_123
    np.testing.assert_allclose(counts.mean(axis=(1, 2)), [18.470, 18.508, 18.542, 18.513, 18.513], atol=5e-4)
    assert (gates == 0).mean() == pytest.approx(0.63224, abs=5e-6)


CLASSES = [(0.1, 0.5), (0.5, 1), (1, 2), (2, 4), (4, 7)]


@pytest.mark.parametrize(("low", "high"), CLASSES)
def test_real_photons_are_poisson_at_low_rates(gates, low, high):
    """Fano factor 1 in each class of mean; the dead time of 4 ns explains less than 2 m tau / T = 0.9 %."""
    per_gate = [fano(gates[:, k].astype(float), low, high) for k in range(6)]
    value = np.mean([f for f, _, _ in per_gate])
    error = np.sqrt(np.sum([e**2 for _, e, _ in per_gate])) / 6
    mean = np.mean([m for _, _, m in per_gate])
    dead = 2 * 6 * mean * DEAD_TIME / PIXEL_TIME  # six gates share the pixel's dead time
    assert abs(value - 1) < critical_z(1e-4, len(CLASSES)) * error + dead


def given_total(gates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each gate frame the share of a pixel's total that it should hold [6], and the totals [H, W]."""
    share = gates.mean(axis=(0, 2, 3), dtype=float)
    return share / share.sum() / 5, gates.sum(axis=(0, 1), dtype=np.int64)


def test_the_histogram_of_real_photons_is_binomial_given_the_pixels_total(gates):
    """Poisson counts given their sum are binomial: an exact prediction of all codes 0 ... 7 without a fitted mean.

    The 30 samples of a pixel add up to its total, so the variance of a code's share is at most the independent one.
    """
    from scipy.stats import binom

    share, total = given_total(gates)
    clipped = np.minimum(gates, 7)
    for code in range(8):
        p = [binom.pmf(code, total, s) if code < 7 else binom.sf(6, total, s) for s in share]
        expected = 5 * sum(x.sum() for x in p)
        sigma = np.sqrt(5 * sum((x * (1 - x)).sum() for x in p))
        assert abs((clipped == code).sum() - expected) < critical_z(1e-4, 8) * sigma


def test_the_three_bit_mean_of_real_photons_is_that_of_our_sensor(gates):
    """E min(N, 7) of the closed form at the measured means, corrected for their own noise.

    The estimated mean m scatters with the variance m / 30 around the true one, which lowers the concave expectation by
    E''(m) m / 60 on average (0.002 in all); the rest has to agree within the error of the data, 0.0005.
    """
    share, total = given_total(gates)
    totals, pixels = np.unique(total, return_counts=True)
    weights = pixels / total.size
    expected = []
    variance = []
    for s in share:
        mean = totals * s
        closed, up, down = (ideal.mean(np.maximum(mean + d, 0), 1.0) for d in (0.0, 0.05, -0.05))
        curvature = np.where(mean > 0.05, (up + down - 2 * closed) / 0.05**2, 0.0)
        expected.append((closed - curvature * mean * s / 2) @ weights)
        variance.append(ideal.variance(mean, 1.0) @ weights)
    measured = np.minimum(gates, 7).mean()
    assert measured == pytest.approx(1.82615, abs=5e-6)
    error = np.sqrt(np.mean(variance) / gates.size)
    assert abs(measured - np.mean(expected)) < critical_z(1e-4) * error
    assert abs(measured - np.mean(expected) - 0.002) > critical_z(1e-4) * error  # the test would see 0.002


def test_a_quiet_qis_of_gain_1_counts_like_the_detector(gates):
    """A QIS without read noise is the same clip of the same Poisson law: code for code, to rounding."""
    light = np.unique(given_total(gates)[1] / 30.0)
    qis = QIS(1.0, 0.0, 0.0, 3)
    np.testing.assert_allclose(qis.cdf(light, 1.0), ideal.cdf(light, 1.0), atol=1e-12)


HIGH = [(20, 30), (30, 40), (40, 60), (60, 100), (100, 130)]


@pytest.mark.parametrize(("low", "high"), HIGH)
def test_dead_time_explains_the_fano_factor_at_high_rates(counts, low, high):
    """(1 - m tau / T)^2, the renewal law of a non-paralyzable counter, at tau = 4.0 +- 0.3 ns, against five scans."""
    value, error, mean = fano(counts.astype(float), low, high)
    explained = (1 - mean * DEAD_TIME / PIXEL_TIME) ** 2
    from_tau = 2 * (1 - mean * DEAD_TIME / PIXEL_TIME) * mean * 0.3e-9 / PIXEL_TIME
    assert abs(value - explained) < critical_z(1e-4, len(HIGH)) * np.hypot(error, from_tau)
    if mean > 60:
        assert value < 1 - 5 * error  # Poisson would not do


@pytest.mark.parametrize("mean", [35.0, 80.0, 110.0])
def test_our_dead_time_models_have_the_fano_factor_that_the_detector_shows(mean):
    """Closed form (live at the start) and events (carried) both give (1 - m tau / T)^2, to the next order (tau / T)."""
    share = DEAD_TIME / PIXEL_TIME
    arrivals = mean / (1 - mean * share)  # m = r / (1 + r tau)
    sensor = CountingSPAD(1.0, 0.0, DEAD_TIME, 8)
    light = np.array(arrivals)
    found = float(sensor.variance(light, PIXEL_TIME) / sensor.mean(light, PIXEL_TIME))
    assert found == pytest.approx((1 - mean * share) ** 2, abs=3 * share)
    n = 1500
    rng = np.random.default_rng(int(mean))
    drawn = simulate(sensor, np.full((n, 1), arrivals), PIXEL_TIME, PIXEL_TIME, Memory(carry=True), rng)
    fano_drawn = drawn.var(ddof=1) / drawn.mean()
    assert abs(fano_drawn - (1 - mean * share) ** 2) < critical_z(1e-4, 3) * np.sqrt(2 / n)


# ---- Dark counts of a SPAD512, 50 x 50 pixels, 7650 frames of 10.3 us

FRAMES = 7650


def dark_counts() -> np.ndarray:
    return np.round(-np.expm1(-shared("spad512_darkcounts_YX.npy")) * FRAMES).astype(int)


def test_the_dark_model_has_the_measured_share_of_hot_pixels():
    measured = dark_counts()
    rates = -np.log1p(-measured / FRAMES)
    relative = rates / np.median(rates)
    model = DarkSpread()
    for limit in (5.0, 10.0, 76.0):
        tail = (limit**-model.tail - model.hot_to**-model.tail) / (
            model.hot_from**-model.tail - model.hot_to**-model.tail
        )
        assert_share(int((relative > limit).sum()), relative.size, model.hot_share * tail, false_alarm=1e-3, checks=4)
    assert_share(int((relative > 3).sum()), relative.size, model.hot_share, false_alarm=1e-3, checks=4)


def test_the_body_of_the_dark_model_is_the_measured_one():
    """Counts of the model's pixels in 7650 planes against the measured ones, both below 3 medians (two-sample KS).

    The scale is the measured mean of the body (9.68 counts). The measured spread beyond Poisson, 17.7 %, has the
    standard error sqrt(2 / n) var / mean^2 in its square; 10 % of spread, or none, would be seen.
    """
    measured = dark_counts().ravel()
    body = measured[measured < 3 * np.median(measured)]
    model = DarkSpread()
    rates = (
        body.mean() / np.exp(model.spread**2 / 2) * draw_maps(FixedPattern(dark=model), (100, 100)).dark * model.mean
    )
    drawn = np.random.default_rng(0).binomial(FRAMES, -np.expm1(-rates / FRAMES)).ravel()
    drawn = drawn[drawn < 3 * np.median(measured)]
    assert ks_2samp(body, drawn).pvalue > 1e-3

    def excess(counts: np.ndarray) -> float:
        return float((counts.var() - counts.mean()) / counts.mean() ** 2)

    error = np.sqrt(2 / body.size) * body.var() / body.mean() ** 2
    assert abs(excess(body) - excess(drawn)) < critical_z(1e-3) * error * np.sqrt(1 + body.size / drawn.size)
    assert excess(body) - 0.1**2 > critical_z(1e-3) * error


def test_a_measured_dark_map_serves_as_a_sensor():
    """Planes drawn with the measured map fire as often, pixel by pixel, as the camera did."""
    from qsim.sensor.spad import BinarySPAD

    rates = -np.log1p(-dark_counts() / FRAMES)
    mean, relative = measured_dark_map(rates)
    exposure = 10.3e-6
    planes = 800
    sensor = BinarySPAD(0.5, mean / exposure)
    codes = PixelArray(sensor, Maps(dark=relative)).sample(
        np.zeros((planes, 50, 50), np.float32), exposure, key=Key(1, 2)
    )
    p = dark_counts() / FRAMES
    fired = codes.sum(axis=0)
    assert (fired[p == 0] == 0).all()
    total = p.sum() * planes
    assert abs(fired.sum() - total) < critical_z(1e-4) * np.sqrt((planes * p * (1 - p)).sum())
    hot = p > 0.01
    z = (fired[hot] - planes * p[hot]) / np.sqrt(planes * p[hot] * (1 - p[hot]))
    assert np.abs(z).max() < critical_z(1e-4, int(hot.sum()))


def test_bad_pixels_are_placed_independently_like_the_measured_ones():
    """SwissSPAD2: 4993 bad pixels in 4619 blobs; independent placement gives 4600 +- 18 blobs, 4251 +- 33 singles."""
    measured = shared("swissspad2_badpixels_YX.npy")
    share = measured.mean()
    assert share == pytest.approx(0.03963, abs=5e-6)
    ours = draw_maps(FixedPattern(dead=float(share), device_seed=1), measured.shape).dead
    assert_share(int(ours.sum()), ours.size, share, false_alarm=1e-4)

    def blobs(mask: np.ndarray) -> tuple[int, int]:
        label, n = ndimage.label(mask)
        return n, int((np.bincount(label.ravel())[1:] == 1).sum())

    limit = critical_z(1e-4, 2)
    scale = ours.sum() / measured.sum()  # blobs are nearly proportional to the number of bad pixels
    assert abs(blobs(ours)[0] / scale - blobs(measured)[0]) < limit * np.hypot(18, 18)
    assert abs(blobs(ours)[1] / scale - blobs(measured)[1]) < limit * np.hypot(33, 33)
