"""Methods tried on pieces of a stream: which one is taken, what a trial costs, and what it reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter

from qsim.keys import Key
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.restoration import automatic, trial
from quiver.restoration.interface import Restorer

EXPOSURE = 5e-4
WINDOW = 3


def stream_of(light: Array, ppp: float, bits: int = 3, seed: int = 0) -> Codes:
    """Return codes of light [T, H, W], brought to a mean of `ppp` photons."""
    sensor = Illumination.of("quiver-physical", ppp, bits).device(EXPOSURE)
    codes = sensor.sample(light * (ppp / light.mean()), EXPOSURE, key=Key(seed, 1), engine="reference")
    return replace(array_codes(codes, sensor, EXPOSURE), ppp=ppp)


def soft(frames: int, side: int, seed: int = 0) -> Array:
    """Return still light [T, H, W] without detail."""
    rng = np.random.default_rng(seed)
    return np.stack([1.5 + gaussian_filter(rng.normal(size=(side, side)), 6) * 6] * frames).clip(0.1)


def blurring(name: str, sigma: float, log: list[int] | None = None) -> Restorer:
    """Return a method that blurs the mean of three frames; it logs the pixels that it restores."""

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        table = codes.sensor.response(codes.exposure)
        for t in range(len(out)):
            seen = codes.read(max(0, first + t - 1), min(codes.shape[0], first + t + 2)).mean(axis=0)
            out[t] = table.invert(gaussian_filter(seen, sigma), 1000)
            if log is not None:
                log.append(out[t].size)

    return Restorer(name, WINDOW, 1, False, "a test", fill)


def test_the_better_method_is_taken_from_either_side():
    codes = stream_of(soft(12, 96), 3.25)
    sharp = blurring("sharp", 0.7)
    smooth = blurring("smooth", 3.0)
    for first, other in ((sharp, smooth), (smooth, sharp)):
        verdict = trial.tried(codes, [first, other], 3)
        assert (verdict.best, verdict.rival) == ("smooth", "sharp")
        assert verdict.sure
        assert "standard errors better than sharp on 3 pieces" in str(verdict)


def test_the_stated_lead_is_that_of_the_light():
    light = soft(12, 96)
    light *= 3.25 / light.mean()
    codes = stream_of(light, 3.25)
    methods = [blurring("sharp", 1.0), blurring("smooth", 2.0)]
    errors = [float(np.mean((method.restore(codes) - light) ** 2)) for method in methods]
    verdict = trial.tried(codes, methods, 6)
    assert verdict.sure
    assert abs(verdict.lead - (errors[0] - errors[1])) < 3 * verdict.error


def test_equal_methods_leave_the_first_one():
    codes = stream_of(soft(12, 96), 3.25)
    for seed in range(5):
        verdict = trial.tried(codes, [blurring("one", 1.5), blurring("another", 1.5)], 4, seed)
        assert verdict.best == "one"
        assert not verdict.sure
        assert "no sure difference" in str(verdict)


def test_a_trial_follows_from_its_seed():
    codes = stream_of(soft(12, 96), 3.25)
    methods = [blurring("one", 1.5), blurring("another", 1.8)]
    assert trial.tried(codes, methods, 3, 1) == trial.tried(codes, methods, 3, 1)
    assert trial.tried(codes, methods, 3, 1) != trial.tried(codes, methods, 3, 2)


def test_a_hopeless_method_is_tried_no_further():
    codes = stream_of(soft(30, 96), 3.25)
    log: list[int] = []
    trial.tried(codes, [blurring("smooth", 3.0), blurring("also", 3.1), blurring("sharp", 0.5, log)], 6)
    assert len(log) == 2 * trial.FEWEST


@pytest.mark.parametrize("seed", range(20))
def test_a_trial_costs_at_most_its_share(seed):
    """Pixels that are restored, of random streams, against those of the stream."""
    rng = np.random.default_rng(seed)
    frames = int(rng.integers(1, 4000))
    height, width = (int(n) for n in rng.integers(48, 200, 2))
    log: list[int] = []
    methods = [blurring("one", 1.5, log), blurring("qbp-bm3d:5", 1.6, log)]
    calls = []

    def read(start: int, stop: int) -> Array:
        calls.append(stop - start)
        return np.random.default_rng(start).poisson(3.0, (stop - start, height, width)).clip(0, 7).astype(np.uint8)

    codes = replace(stream_of(np.ones((1, 8, 8)), 3.25), shape=(frames, height, width), read=read)
    pieces = trial.affordable(codes, methods)
    assert pieces <= trial.PIECES
    if pieces:
        trial.tried(codes, methods, pieces)
    # two methods, of costs 1 and 4, that restored equally many pixels
    assert sum(log) / 2 * (1 + trial.COSTS["qbp-bm3d"]) <= trial.COST * frames * height * width
    assert len(calls) <= pieces
    assert max(calls, default=0) <= WINDOW


def test_pieces_are_spread_over_the_stream_and_lie_within_it():
    rng = np.random.default_rng(0)
    for seed in range(50):
        shape = (int(rng.integers(1, 500)), int(rng.integers(48, 400)), int(rng.integers(48, 400)))
        found = list(trial.places(shape, 6, 11, seed))
        frames = sorted(place.frame for place in found)
        end = min(5, (shape[0] - 1) // 2)
        inner = shape[0] - 2 * end
        for n, frame in enumerate(frames):
            assert n * inner / 6 - 1 < frame - end < (n + 1) * inner / 6
        for place in found:
            assert 0 <= place.y <= place.y + place.height <= shape[1]
            assert 0 <= place.x <= place.x + place.width <= shape[2]


def test_a_piece_does_not_look_across_a_cut():
    codes = replace(stream_of(soft(12, 96), 3.25), cuts=(6,))
    reads = []

    def read(start: int, stop: int) -> Array:
        reads.append((start, stop))
        return codes.read(start, stop)

    trial.tried(replace(codes, read=read), [blurring("one", 1.5), blurring("another", 1.6)], 6)
    assert reads
    assert all(stop <= 6 or start >= 6 for start, stop in reads)


def constant(name: str, photons: float) -> Restorer:
    """Return a method that restores the same light everywhere."""

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        out[:] = photons

    return Restorer(name, WINDOW, 1, False, "a test", fill)


def test_filled_pixels_do_not_count():
    """A third of the columns is stuck at the top code, which reads as bright light."""
    codes = stream_of(np.ones((12, 96, 96)), 3.25)
    bad = np.zeros((96, 96), bool)
    bad[:, ::3] = True

    def read(start: int, stop: int) -> Array:
        found = codes.read(start, stop).copy()
        found[:, bad] = 7
        return found

    methods = [constant("right", 3.25), constant("bright", 4.5)]
    stuck = replace(codes, read=read)
    assert trial.tried(stuck, methods, 3).best == "bright"
    assert trial.tried(replace(stuck, defective=bad), methods, 3).best == "right"


def checkerboard(frames: int, side: int) -> Array:
    y, x = np.mgrid[:side, :side]
    return np.stack([1 + 0.8 * (2.0 * ((y + x) % 2) - 1)] * frames)


def boxes(frames: int, side: int) -> Array:
    """Return boxes that stand still, [T, H, W]."""
    rng = np.random.default_rng(1)
    picture = np.ones((side, side))
    for _ in range(40):
        y, x = rng.integers(0, side - 8, 2)
        height, width = rng.integers(3, 16, 2)
        picture[y : y + height, x : x + width] = rng.uniform(0.2, 2.0)
    return np.stack([picture] * frames)


@pytest.mark.parametrize(("light", "best"), [(checkerboard, "qbp-bm3d"), (boxes, "mergenet")])
def test_auto_takes_what_is_better_on_the_stream(light, best):
    """BM3D finds a fine checkerboard everywhere; mergenet averages what stands still."""
    codes = stream_of(light(13, 64), 3.25)
    method, why = automatic.chosen("auto", codes, cost=np.inf)
    assert method.name.partition(":")[0] == best
    assert f"auto: {method.name}; " in why
    assert "pieces of the stream" in why
    assert ("standard errors better than mergenet" in why) == (best != "mergenet")


def test_a_short_stream_is_told_that_nothing_was_tried():
    codes = stream_of(boxes(13, 64), 3.25)
    method, why = automatic.chosen("auto", codes)
    assert method.name == "mergenet"
    assert "too few frames or pixels for a trial" in why
