"""Tests codes, photons and truth of every path against a plain loop over the exposures of each code.

Random sensors, bits, clip frames per code, schedules, rows, drift, crops and windows. The loop knows the law of one
exposure (`Sensor.sample`) and the time of each pixel row; all else is written out here.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from clips import ClipMaker
from numpy import ndarray as Array

from qsim.formats import pairs
from qsim.formats.summing import summed
from qsim.keys import Key
from qsim.plane_sums import PlaneSums
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.data.codes import sensed, stored
from quiver.data.illumination import Illumination
from quiver.data.window_noise import window_codes
from quiver.data.windows import Windows, WindowSettings, turned

FRAMES = 23
SIZE = (9, 11)


@dataclass(frozen=True)
class Case:
    """A random stream, and the facts that the loop needs."""

    sensing: Sensing
    planes: int
    summed: bool
    shift: float  # clip frames from one row to the next
    shares: tuple[float, ...]
    drift: float

    @classmethod
    def draw(cls, rng: random.Random) -> Case:
        planes = rng.choice([1, 2, 3, 7])
        model = rng.choice(["sum", "sum", "qis", "counter"])
        if model == "sum":
            planes = rng.choice([1, 2, 3, 4, 5, 6, 7, 10])
            sensor: Sensor = BinarySPAD(0.6, 300.0, planes.bit_length(), planes)
        elif model == "qis":
            sensor = QIS(0.8, 40.0, 0.3, rng.choice([1, 3, 10]))
        else:
            sensor = CountingSPAD(0.5, 100.0, 1e-12, rng.choice([3, 5]))
        times: dict[str, Any] = {}
        shift = 0.0
        if rng.random() < 0.4:
            shift = rng.choice([0.05, 0.1])
            times |= {"row_delay": shift * 5e-4, "row_order": "down"}
        shares = rng.choice([(1.0,), (1.0,), (1.0, 0.25), (0.5,)])
        if shares != (1.0,) and not (model == "counter" and planes > 1):
            times["exposures"] = shares
        else:
            shares = (1.0,)
        drift = rng.choice([0.0, 0.0, 0.3])
        more = {"group": model == "sum" and planes > 1, "slices": 1 if model == "sum" else planes}
        sensing = Sensing(
            sensor, ppp=rng.choice([0.5, 4.0, 30.0]), seed=rng.randrange(9), light_drift=drift, **more, **times
        )
        return cls(sensing, planes, model == "sum" and planes > 1, shift, shares, drift)

    def light(self, clip: Clip, factor: float, t: int, sharp: bool = False) -> Array:
        """Photons [exposures, H, W] of code t, row by row and frame by frame; of its sharp middle [1, H, W]."""
        codes = self.codes
        strength = 1 + self.drift * t / max(codes - 1, 1)
        exposures = [[t * self.planes + i] for i in range(self.planes)]
        if not self.summed:
            exposures = [[frame for (frame,) in exposures]]
        found = np.zeros((1 if sharp else len(exposures), *SIZE))
        for y in range(SIZE[0]):
            late = y * self.shift
            if sharp:
                frame = math.floor((t + 0.5) * self.planes + late)
                found[0, y] = factor * self.planes * strength * clip.sharp(frame)[y].astype(float)
                continue
            for n, frames in enumerate(exposures):
                for frame, part in zip(frames, self.parts(len(frames), t), strict=True):
                    first = frame + math.floor(late)
                    share = late - math.floor(late)
                    row = clip.radiance(first)[y].astype(float)
                    if share:
                        row = (1 - share) * row + share * clip.radiance(first + 1)[y].astype(float)
                    found[n, y] += factor * part * strength * row
        return found

    def parts(self, slices: int, t: int) -> list[float]:
        """How much of each slice lies within the open share around the middle of an exposure."""
        open_ = self.share(t) * slices
        begin = (slices - open_) / 2
        return [max(0.0, min(i + 1, begin + open_) - max(i, begin)) for i in range(slices)]

    def share(self, t: int) -> float:
        return self.shares[t % len(self.shares)]

    @property
    def codes(self) -> int:
        return (FRAMES - math.ceil((SIZE[0] - 1) * self.shift)) // self.planes

    def stream(self, clip: Clip, factor: float, key: Key) -> tuple[Array, Array]:
        """Codes and the photons of their exposures, [T, H, W] each, from a loop over codes and their exposures."""
        sensor = self.sensing.sensor
        assert isinstance(sensor, Sensor)
        single = replace(sensor, bits=1, summed=None) if self.summed else sensor
        codes = []
        photons = []
        for t in range(self.codes):
            light = self.light(clip, factor, t)
            seconds = self.share(t) * clip.exposure * (1 if self.summed else self.planes)
            first = t * self.planes if self.summed else t
            drawn = [
                single.sample(each[None], seconds, key=key.at(first + n), engine="reference")[0].astype(int)
                for n, each in enumerate(light)
            ]
            codes.append(np.sum(drawn, axis=0))
            photons.append(light.sum(axis=0))
        return np.stack(codes), np.stack(photons)


def check(case: Case, clip: Clip, rng: random.Random) -> None:
    """Compare every path with the loop."""
    stream, _ = sense(clip, replace(case.sensing, name="searched"), force=True)
    factor = stream.photons_factor
    codes, photons = case.stream(clip, factor, Key(case.sensing.seed, stream.info.clip_key))
    truth = np.concatenate([case.light(clip, factor, t, sharp=True) for t in range(case.codes)])
    np.testing.assert_array_equal(stream.codes(), codes)
    np.testing.assert_allclose(stream.truth(), truth, rtol=1e-12)
    found = stream.code_truth
    np.testing.assert_allclose(np.stack([found.mean(t) for t in range(case.codes)]), photons, rtol=1e-12)
    assert stream.exposure == pytest.approx(clip.exposure * case.planes)
    for own, its in (stored(clip, "searched"), sensed(clip, Illumination(case.sensing), case.sensing.seed)):
        np.testing.assert_array_equal(own.read(0, case.codes), codes)
        np.testing.assert_allclose(its.video(), truth, rtol=1e-12)
        assert (own.exposure, own.frame_rate) == pytest.approx((stream.exposure, stream.info.frame_rate))
    check_windows(case, clip, rng, codes, photons, truth, Key(case.sensing.seed, stream.info.clip_key))
    if case.summed and case.shares == (1.0,) and not (case.drift or case.shift):
        check_stored_planes(case, clip, codes, truth)
    if case.shares == (1.0,):
        window = pairs.Window(clip, stream, 1, case.codes - 1)
        np.testing.assert_array_equal(window.codes(), codes[1:])
        np.testing.assert_allclose(window.truth(), truth[1:], rtol=1e-6)
        np.testing.assert_array_equal(window.flow()[:-1], expected_flow(case)[1:])


def check_stored_planes(case: Case, clip: Clip, codes: Array, truth: Array) -> None:
    """Stored planes of the same light, summed when they are read: by evaluation, and for pairs and other programs."""
    sensor = case.sensing.sensor
    assert isinstance(sensor, BinarySPAD)
    assert case.sensing.ppp is not None
    single = replace(case.sensing, sensor=sensor.plane, ppp=case.sensing.ppp / case.planes, group=False, name="planes")
    stream, _ = sense(clip, single, force=True)
    own, its = stored(clip, "planes", case.planes)
    for found in (own.read(0, case.codes), summed(stream, PlaneSums(planes=case.planes)).codes()):
        np.testing.assert_array_equal(found, codes)
    np.testing.assert_allclose(its.video(), truth, rtol=1e-12)
    assert (own.ppp, own.sensor) == (pytest.approx(case.sensing.ppp), sensor)


def expected_flow(case: Case) -> Array:
    """The flow of a pattern that moves evenly, 0.5 px per clip frame to the right, until it leaves: NaN then."""
    found = np.full((case.codes - 1, 2, *SIZE), np.nan, np.float32)
    if case.shift:
        return found
    found[:, 0] = 0.5 * case.planes
    found[:, 1] = 0.0
    # A step begins within half a pixel of the picture; the last one may leave it, as this clip calls all pixels valid.
    found[..., np.arange(SIZE[1]) > SIZE[1] - case.planes / 2] = np.nan
    return found


def check_windows(
    case: Case, clip: Clip, rng: random.Random, codes: Array, photons: Array, truth: Array, key: Key
) -> None:
    """Windows are the crops of codes, photons and truth, under the key of the stream to the last code."""
    light = Illumination.of_stream(clip.stream("searched"))
    frames = rng.randint(1, min(5, case.codes))
    data = Windows([clip], WindowSettings((light,), frames=frames, crop=5, seed=rng.randrange(99)))
    for n in range(2):
        place = data.place(n)
        part = (slice(place.start, place.start + frames), slice(place.y, place.y + 5), slice(place.x, place.x + 5))
        exposed, sharp = data.photons_of(place)
        np.testing.assert_allclose(exposed, turned(photons[part], place), rtol=1e-12)
        np.testing.assert_allclose(sharp, turned(truth[part], place), rtol=1e-12)
        assert data[n]["codes"].shape == (frames, 1, 5, 5)
        forward = replace(place, key=key, turn=0, backwards=False)
        if case.planes > 1 or not isinstance(case.sensing.sensor, BinarySPAD) or case.sensing.sensor.bits == 1:
            drawn = window_codes(light, light.draw(clip), clip, forward, frames, 5)
            np.testing.assert_array_equal(drawn, codes[part])


@pytest.mark.parametrize("cases", [2, pytest.param(400, marks=pytest.mark.slow)])
def test_every_path_agrees_with_a_loop_over_planes(make_clip: ClipMaker, cases: int):
    flow = np.zeros((2, *SIZE), np.float32)
    flow[0] = 0.5
    rng = random.Random(cases)
    shape = {"frames": FRAMES, "height": SIZE[0], "width": SIZE[1]}
    clip = make_clip("searched", sharp=True, flow=flow, relative=True, **shape)
    for _ in range(cases):
        check(Case.draw(rng), clip, rng)
