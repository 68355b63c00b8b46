"""Training windows: exact codes, keyed noise, the same bytes for any number of workers, targets where they belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import ClipMaker, sliding_pattern
from numpy import ndarray as Array
from stats import assert_histogram, assert_mean
from torch.utils.data import DataLoader

from qsim.clip.photons import clip_photons, light_level
from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from quiver.data.clips import open_clips, truth
from quiver.data.code_table import CodeTable, draw_codes
from quiver.data.codes import array_codes, sensed
from quiver.data.illumination import Illumination
from quiver.data.photon_cubes import cube_codes
from quiver.data.windows import Batches, Windows, WindowSettings, as_input

EXPOSURE = 5e-4
SENSORS = (
    QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25),
    QIS(0.8, 3200.0, 0.0, 2),
    QIS(0.8, 1.6, 2.0, 5, gain=0.3, full_well=20.0),
    BinarySPAD(0.4, 100.0, bits=1),
    CountingSPAD(0.5, 25.0, 5e-5, 3),
)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{type(s).__name__}-{s.bits}")
def test_table_draws_are_the_reference_draws(sensor: Sensor):
    """Every code, from darkness to far beyond saturation, equals the sensor's own slow draw."""
    photons = np.random.default_rng(0).choice([0, 1e-6, 0.3, 1, 3.25, 7, 20, 300, 1e6], (3, 40, 50))
    photons = photons * np.random.default_rng(1).uniform(0.5, 1.5, photons.shape)
    key = Key(seed=3, clip=5, frame=2)
    expected = sensor.sample(photons, EXPOSURE, key=key, engine="reference")
    np.testing.assert_array_equal(draw_codes(sensor, photons, EXPOSURE, key), expected)


def test_sums_of_planes_have_the_exact_distribution():
    """A clocked SPAD draws plane by plane; its table draws the sum: the same binomial law."""
    sensor = BinarySPAD(1.0, 0.0, bits=3)
    for level in (0.5, 4.9, 20.0):
        codes = draw_codes(sensor, np.full((5, 80, 100), level), EXPOSURE, Key(1, int(level)))
        assert_histogram(codes, np.exp(sensor.log_pmf(np.array([level]), EXPOSURE)[0]), checks=3)


def test_the_table_decides_most_pixels_itself():
    """Otherwise it would be exact for a dull reason: 3 bits leave 1 to 2 % of the cells open."""
    table = CodeTable(SENSORS[0], EXPOSURE)
    assert 0.003 < np.mean(table.table == CodeTable.UNDECIDED) < 0.03
    assert set(np.unique(table.table)) == {0, 1, 2, 3, 4, 5, 6, 7, 255}


def test_a_table_asks_for_second_words_where_one_does_not_decide():
    sensor = SENSORS[0]
    photons = np.full((1, 1), 3.25)
    edge = np.array([[int(sensor.cdf(photons, EXPOSURE)[0, 0, 2] * 2**32)]], dtype=np.uint32)
    table = CodeTable(sensor, EXPOSURE)
    with pytest.raises(LookupError, match="second words"):
        table.draw(photons, edge)
    least, most = (table.draw(photons, edge, np.full((1, 1), w, np.uint32)) for w in (0, 2**32 - 1))
    assert (least, most) == (2, 3)


def test_sensors_that_fit_no_table_are_drawn_by_themselves():
    """A paralyzable counter's codes fall again at high light; ten bits have too many thresholds."""
    photons = np.full((2, 5, 7), 30.0)
    for sensor in (CountingSPAD(0.5, 25.0, 5e-5, 3, paralyzable=True), QIS(0.8, 1.6, 5.1, 10, offset=32.0)):
        expected = sensor.sample(photons, EXPOSURE, key=Key(1, 2), engine="reference")
        np.testing.assert_array_equal(draw_codes(sensor, photons, EXPOSURE, Key(1, 2)), expected)
    with pytest.raises(ValueError, match="do not grow with light"):
        CodeTable(CountingSPAD(0.5, 25.0, 5e-5, 3, paralyzable=True), EXPOSURE)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_bad_photons_are_named(bad: float):
    photons = np.ones((2, 5, 7))
    photons[1, 4, 2] = bad
    with pytest.raises(ValueError, match="photons"):
        draw_codes(SENSORS[0], photons, EXPOSURE, Key(1, 2))


def windows(make_clip: ClipMaker, **settings: object) -> Windows:
    clips = [make_clip(f"clip_{i}", seed=i) for i in range(3)]
    return Windows(clips, WindowSettings(crop=16, **settings), repeats=2)


def same(a: dict, b: dict) -> bool:
    return all(torch.equal(v, b[k]) if isinstance(v, torch.Tensor) else v == b[k] for k, v in a.items())


def test_a_sample_is_what_the_docs_say(make_clip: ClipMaker):
    """Undo nothing, flip nothing: the target is the sharp photons of that place over white, codes come from its key."""
    clip = make_clip(sharp=True)
    data = Windows([clip], WindowSettings(crop=16, flips=False, reverse=False, seed=7))
    sample, place = data[1], data.place(1)
    light = Illumination()
    sensor, factor = light.device(clip.exposure), light_level(clip, ppp=3.25).factor
    crop, times = (place.y, place.x, 16, 16), range(place.start, place.start + 11)
    sharp = np.stack([clip_photons(clip, t, factor, crop, sharp=True) for t in times])
    exposed = np.stack([clip_photons(clip, t, factor, crop) for t in times])
    np.testing.assert_allclose(sample["target"][:, 0], sharp / 8.125, rtol=1e-6)
    codes = sensor.sample(exposed, clip.exposure, key=place.key, engine="reference")
    np.testing.assert_array_equal(sample["codes"][:, 0], (codes / np.float32(7)).astype(np.float32))
    assert sample["codes"].shape == sample["target"].shape == (11, 1, 16, 16)
    assert sample["white"] == pytest.approx(8.125)
    assert sharp.mean() == pytest.approx(1.1 * exposed.mean(), rel=1e-3)


def test_codes_have_the_mean_of_their_photons(make_clip: ClipMaker):
    """A flat clip: 11 x 36 x 36 codes per sample against the sensor's exact mean and variance, turned or not."""
    clip = make_clip(radiance=np.full((14, 36, 36), 0.7), relative=True)
    sample = Windows([clip], WindowSettings(crop=36))[0]
    sensor = Illumination().device(clip.exposure)
    codes = sample["codes"].numpy() * 7
    level = np.array([3.25])
    assert_mean(codes, sensor.mean(level, 5e-4)[0], sensor.variance(level, 5e-4)[0])
    np.testing.assert_allclose(sample["target"], 3.25 / 8.125, rtol=1e-3)
    frames = codes[:, 0]
    assert all((frames[a] != frames[b]).any() for a in range(11) for b in range(a))


@pytest.mark.parametrize("turn", range(8))
@pytest.mark.parametrize("backwards", [False, True])
def test_turns_move_codes_and_target_together(make_clip: ClipMaker, turn: int, backwards: bool):
    """At a million photons noise is invisible: codes are the clipped target, whatever the turn."""
    data = windows(make_clip, lights=(Illumination("quiver-paper", ppp=3.25),))
    place = replace(data.place(0), turn=turn, backwards=backwards)
    exposed, sharp = data.photons_of(place)
    plain, _ = data.photons_of(replace(place, turn=0, backwards=False))
    np.testing.assert_array_equal(exposed, sharp)
    assert sorted(exposed.ravel()) == sorted(plain.ravel())
    if turn or backwards:
        assert not np.array_equal(exposed, plain)
    if backwards and turn == 0:
        np.testing.assert_array_equal(exposed, plain[::-1])


def test_a_drifting_crop_is_the_clip_under_a_moving_window(make_clip: ClipMaker):
    """Frame i is the clip's frame at (y, x) + i (dy, dx), never outside; half of the windows stay, all ways occur."""
    clip = make_clip(height=48, width=40)
    data = Windows([clip], WindowSettings(crop=16, flips=False, reverse=False, drift=2))
    places = [data.place(n) for n in range(600)]
    for place in places:
        for start, way, side in zip((place.y, place.x), place.drift, (48, 40), strict=True):
            assert 0 <= min(start, start + 10 * way) <= max(start, start + 10 * way) <= side - 16
    drifts = [place.drift for place in places]
    assert set(drifts) == {(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3)}
    still = 0.5 + 0.5 / 25
    assert_mean(np.array([drift == (0, 0) for drift in drifts]), still, still * (1 - still))
    place = next(place for place in places if place.drift == (-2, 1))
    factor = light_level(clip, ppp=3.25).factor
    for i, frame in enumerate(data.photons_of(place)[0]):
        crop = (place.y - 2 * i, place.x + i, 16, 16)
        np.testing.assert_array_equal(frame, clip_photons(clip, place.start + i, factor, crop))
    narrow = Windows([make_clip("narrow", height=16, width=27)], WindowSettings(crop=16, drift=9))
    assert {narrow.place(n).drift for n in range(100)} == {(0, -1), (0, 0), (0, 1)}


def test_epochs_and_samples_have_their_own_noise(make_clip: ClipMaker):
    data = windows(make_clip)
    assert len(data) == 6
    assert same(data[4], data[4])
    assert not torch.equal(data[4]["codes"], data[4 + 6]["codes"])
    clips = [data.place(n).clip for n in range(12)]
    assert sorted(clips[:6]) == sorted(clips[6:]) == [0, 0, 1, 1, 2, 2]  # an epoch sees every clip equally often
    assert not same(data[4], windows_with_seed(data, 1)[4])


def windows_with_seed(data: Windows, seed: int) -> Windows:
    return Windows(data.clips, replace(data.settings, seed=seed), repeats=2)


@pytest.mark.parametrize("workers", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_workers_draw_the_same_bytes(make_clip: ClipMaker, workers: int):
    data = windows(make_clip)
    alone = list(DataLoader(data, batch_sampler=Batches(2, 1, 4)))
    loader = DataLoader(data, batch_sampler=Batches(2, 1, 4), num_workers=workers, multiprocessing_context="spawn")
    for ours, theirs in zip(alone, loader, strict=True):
        assert same(ours, theirs)


def test_processes_share_the_samples_without_overlap():
    whole = [number for batch in Batches(4, 0, 3) for number in batch]
    split = [list(Batches(2, 0, 3, rank, 2)) for rank in (0, 1)]
    assert sorted(n for batches in split for batch in batches for n in batch) == whole
    assert split[0][1] + split[1][1] == [4, 5, 6, 7]  # a step of two processes is the step of one with twice the batch


def test_light_levels_are_mixed_and_named(make_clip: ClipMaker):
    lights = (Illumination(ppp=3.25), Illumination(ppp=26.0), Illumination(ppp=3.25, bits=1))
    data = windows(make_clip, lights=lights)
    found = {data.place(n).light for n in range(40)}
    assert found == {0, 1, 2}
    n = next(n for n in range(40) if data.place(n).light == 2)
    assert set(torch.unique(data[n]["codes"]).tolist()) <= {0.0, 1.0}
    assert "3.25 PPP, 1 bit" in data[n]["key"]


def test_published_windows_have_their_own_exposure(make_clip: ClipMaker):
    dim = make_clip("dim", radiance=np.linspace(0.2, 2, 14)[:, None, None] * np.ones((14, 36, 36)))
    clip_level = Windows([dim], WindowSettings(crop=16, frames=3))
    forced = Windows([dim], WindowSettings(crop=16, frames=3, force_exposure=True))
    levels = [clip_level[n]["ppp"] for n in range(8)]
    assert max(levels) > 1.5 * min(levels)
    for n in range(8):
        assert forced[n]["ppp"] == pytest.approx(3.25)
        assert torch.equal(forced[n]["target"], clip_level[n]["target"])


def test_validation_windows_never_change(make_clip: ClipMaker):
    data = Windows([make_clip("a"), make_clip("b", seed=1)], WindowSettings(crop=16), fixed=True)
    assert len(data) == 2
    one, other = data[0], data[0 + len(data)]
    assert torch.equal(one["codes"], other["codes"])
    assert (data.place(0).start, data.place(0).y, data.place(0).x) == (1, 10, 14)


def test_clips_that_hold_no_window_are_named(make_clip: ClipMaker):
    with pytest.raises(ValueError, match="clip short is 5 x 36 x 44; a window needs 11 frames of 16 x 16 px"):
        Windows([make_clip("short", frames=5)], WindowSettings(crop=16))
    with pytest.raises(ValueError, match="no complete clip"):
        Windows([], WindowSettings())


def test_sensed_codes_and_truth(make_clip: ClipMaker):
    """Drawn frame by frame or at once, the codes are the same; truth has the asked light level."""
    clip = make_clip()
    codes, factor = sensed(clip, Illumination(), seed=2)
    whole = codes.read(0, 14)
    np.testing.assert_array_equal(np.concatenate([codes.read(t, t + 1) for t in range(14)]), whole)
    assert truth(clip, factor, 0, 14).mean() == pytest.approx(3.25, rel=1e-6)
    assert codes.white == pytest.approx(8.125)
    assert (sensed(clip, Illumination(), seed=3)[0].read(0, 1) != whole[:1]).any()


def test_photon_cubes(tmp_path, rng_planes: Array):
    """Packed planes, seven to a code; a width that is no multiple of eight; leftover planes are dropped."""
    np.save(tmp_path / "cube.npy", np.packbits(rng_planes, axis=2))
    light = Illumination("spad-320x240", None, 3)
    codes = cube_codes(tmp_path / "cube.npy", light, 1428.0, planes=7, width=13)
    assert codes.shape == (2, 5, 13)
    np.testing.assert_array_equal(codes.read(0, 2), rng_planes[:14].reshape(2, 7, 5, 13).sum(axis=1))
    assert codes.white == pytest.approx(7.0)
    with pytest.raises(ValueError, match=r"no cube of packed planes 30 px wide"):
        cube_codes(tmp_path / "cube.npy", light, 1428.0, planes=7, width=30)
    with pytest.raises(ValueError, match="fewer than the 31 of one code"):
        cube_codes(tmp_path / "cube.npy", Illumination("spad-320x240", None, 5), 300.0, planes=31, width=13)


@pytest.fixture
def rng_planes() -> Array:
    return np.random.default_rng(0).integers(0, 2, (16, 5, 13), dtype=np.uint8)


def test_codes_in_memory_are_checked():
    sensor = SENSORS[0]
    codes = np.zeros((3, 4, 5), np.uint8)
    codes[2, 1, 3] = 8
    with pytest.raises(ValueError, match=r"code 8 at \(t, y, x\) = \(2, 1, 3\); a 3-bit sensor has 0\.\.7"):
        array_codes(codes, sensor, EXPOSURE).read(1, 3)
    with pytest.raises(ValueError, match=r"expected integer codes \[T, H, W\]"):
        array_codes(np.zeros((0, 4, 5), np.uint8), sensor, EXPOSURE)
    assert as_input(np.full((1, 2, 2), 7, np.uint8), sensor).max() == 1.0


def test_splits(tiny_dataset):
    assert [len(open_clips(tiny_dataset, split)) for split in ("train", "val", "test", None)] == [3, 2, 2, 7]
    assert open_clips(open_clips(tiny_dataset)[0].path)[0].shape == (14, 36, 44)


def test_the_pattern_moves():
    """The fixture itself: frame t is frame 0 shifted by 1.5 px per frame, away from the disk's wrap-around."""
    clip = sliding_pattern(5, 36, 44, seed=0)
    assert np.abs(clip[2][:, 3:] - clip[0][:, :-3]).mean() < 0.02 < np.abs(clip[2] - clip[0]).mean()


def test_bad_radiance_names_its_clip(make_clip: ClipMaker, monkeypatch):
    """A damaged file may hold NaN: both ways to codes say which clip, and which frames."""
    clip = make_clip()
    monkeypatch.setattr(type(clip), "radiance", lambda self, t, crop=None: np.full((36, 44), np.nan, np.float32))
    with pytest.raises(ValueError, match=r"sliding_0: frames 2\.\.3: photons"):
        sensed(clip, Illumination())[0].read(2, 4)
    with pytest.raises(ValueError, match=r"sliding_0: window from frame \d: photons"):
        Windows([clip], WindowSettings(crop=36))[0]
