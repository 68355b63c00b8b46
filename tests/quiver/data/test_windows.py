"""Training windows: exact codes, keyed noise, equal bytes for any number of workers, targets in place."""

from __future__ import annotations

import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import ClipMaker, sliding_pattern, write_clip
from sensor_files import QIS, sensor_file
from stats import assert_mean
from torch.utils.data import DataLoader

from qsim.streams.photons import clip_photons, light_level
from quiver.data.clips import open_clips
from quiver.data.codes import sensed
from quiver.data.illumination import Illumination
from quiver.data.windows import Batches, Windows, WindowSettings, shuffled, windows

ROOT = Path(__file__).parents[3]


def three_clips(make_clip: ClipMaker, **settings: object) -> Windows:
    clips = [make_clip(f"clip_{i}", seed=i) for i in range(3)]
    return Windows(clips, WindowSettings(crop=16, **settings), repeats=2)


def same(a: dict, b: dict) -> bool:
    return all(torch.equal(v, b[k]) if isinstance(v, torch.Tensor) else v == b[k] for k, v in a.items())


def test_a_sample_is_what_the_docs_say(make_clip: ClipMaker):
    """Nothing turned: the target is the sharp photons of that place over white, and codes come from its key."""
    clip = make_clip(sharp=True)
    data = Windows([clip], WindowSettings(crop=16, flips=False, reverse=False, seed=7))
    sample = data[1]
    place = data.place(1)
    light = Illumination()
    sensor = light.device(clip.exposure)
    factor = light_level(clip, ppp=3.25).factor
    crop = (place.y, place.x, 16, 16)
    times = range(place.start, place.start + 11)
    sharp = np.stack([clip_photons(clip, t, factor, crop, sharp=True) for t in times])
    exposed = np.stack([clip_photons(clip, t, factor, crop) for t in times])
    np.testing.assert_allclose(sample["target"][:, 0], sharp / 8.75, rtol=1e-6)
    codes = sensor.sample(exposed, clip.exposure, key=place.key, engine="reference")
    np.testing.assert_array_equal(sample["codes"][:, 0], (codes / np.float32(7)).astype(np.float32))
    assert sample["codes"].shape == sample["target"].shape == (11, 1, 16, 16)
    assert sample["white"] == pytest.approx(8.75)
    assert sharp.mean() == pytest.approx(1.1 * exposed.mean(), rel=1e-3)


@pytest.mark.parametrize(
    ("light", "ceiling"),
    [(Illumination.of("spad-320x240", 3.0, 1), 7.5), (Illumination.of("spad-320x240", 21.0, 3), 7.5)],
    ids=["a plane near saturation", "seven planes"],
)
def test_targets_keep_all_light_that_is_scored(make_clip: ClipMaker, light: Illumination, ceiling: float):
    """Light up to the peak of the scores, 2.5 times the mean, is never cut: a SPAD tells it above twice its white."""
    data = Windows([make_clip(sharp=True)], WindowSettings(lights=(light,), crop=16))
    free = Windows(data.clips, replace(data.settings, ceiling=np.inf))
    assert max(float(free[n]["target"].max()) for n in range(4)) > 2
    for n in range(4):
        torch.testing.assert_close(data[n]["target"], free[n]["target"].clamp(max=ceiling))
        assert float(data[n]["peak"]) <= ceiling * data[n]["white"]


def test_codes_have_the_mean_of_their_photons(make_clip: ClipMaker):
    """A flat clip: 11 x 36 x 36 codes per sample against the sensor's exact mean and variance, turned or not."""
    clip = make_clip(radiance=np.full((14, 36, 36), 0.7), relative=True)
    sample = Windows([clip], WindowSettings(crop=36))[0]
    sensor = Illumination().device(clip.exposure)
    codes = sample["codes"].numpy() * 7
    level = np.array([3.25])
    assert_mean(codes, sensor.mean(level, 5e-4)[0], sensor.variance(level, 5e-4)[0])
    np.testing.assert_allclose(sample["target"], 3.25 / 8.75, rtol=1e-3)
    frames = codes[:, 0]
    assert all((frames[a] != frames[b]).any() for a in range(11) for b in range(a))


@pytest.mark.parametrize("turn", range(8))
@pytest.mark.parametrize("backwards", [False, True])
def test_turns_move_codes_and_target_together(make_clip: ClipMaker, turn: int, backwards: bool):
    """At a million photons noise is invisible: codes are the clipped target at every turn."""
    data = three_clips(make_clip, lights=(Illumination.of("quiver-paper", ppp=3.25),))
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
    data = three_clips(make_clip)
    assert len(data) == 6
    assert same(data[4], data[4])
    assert not torch.equal(data[4]["codes"], data[4 + 6]["codes"])
    clips = [data.place(n).clip for n in range(12)]
    assert sorted(clips[:6]) == sorted(clips[6:]) == [0, 0, 1, 1, 2, 2]  # an epoch holds every clip equally often
    assert not same(data[4], windows_with_seed(data, 1)[4])


def windows_with_seed(data: Windows, seed: int) -> Windows:
    return Windows(data.clips, replace(data.settings, seed=seed), repeats=2)


def test_a_pickled_copy_draws_the_same_bytes(make_clip: ClipMaker):
    """As every worker has one."""
    data = three_clips(make_clip)
    copy = pickle.loads(pickle.dumps(data))
    assert all(same(data[n], copy[n]) for n in range(4))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 1])
def test_workers_draw_the_same_bytes(make_clip: ClipMaker, workers: int):
    data = three_clips(make_clip)
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
    lights = (Illumination.of(ppp=3.25), Illumination.of(ppp=26.0), Illumination.of(ppp=3.25, bits=1))
    data = three_clips(make_clip, lights=lights)
    found = {data.place(n).light for n in range(40)}
    assert found == {0, 1, 2}
    n = next(n for n in range(40) if data.place(n).light == 2)
    assert set(torch.unique(data[n]["codes"]).tolist()) <= {0.0, 1.0}
    assert "3.25 PPP, 1 bit" in data[n]["key"]


def test_a_sensor_file_is_not_needed_after_sensing(make_clip: ClipMaker, tmp_path):
    """Its stream holds all that windows are drawn from."""
    clip = make_clip()
    file = Path(sensor_file(tmp_path, QIS + "prnu = 0.02\n", 3))
    clip.sense(file, ppp=3.0)
    expected = Windows([clip], WindowSettings(crop=16))[0]
    file.unlink()
    assert same(Windows([clip], WindowSettings(crop=16))[0], expected)


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
    one = data[0]
    other = data[0 + len(data)]
    assert torch.equal(one["codes"], other["codes"])
    assert (data.place(0).start, data.place(0).y, data.place(0).x) == (1, 10, 14)


@pytest.mark.parametrize("count", [1, 2, 7, 15, 30, 59, 60, 100])
def test_fixed_windows_are_chosen_from_every_clip_and_all_light(make_clip: ClipMaker, count: int):
    """Of 3 clips at 20 levels: distinct, every clip equally often, levels at equal steps; all are in their order."""
    clips = [make_clip(f"clip_{i}", seed=i) for i in range(3)]
    lights = tuple(Illumination.of(ppp=1.0 + i) for i in range(20))
    data = Windows(clips, WindowSettings(lights, crop=16), fixed=True)
    chosen = data.spread(count)
    places = [data.place(n) for n in chosen]
    assert len(set(chosen)) == len(chosen) == min(count, 60)
    taken = np.bincount([place.clip for place in places], minlength=3)
    assert taken.max() - taken.min() <= 1
    assert [place.light for place in places] == [n * 20 // len(chosen) for n in range(len(chosen))]
    if count >= 60:
        assert chosen == list(range(60))


def test_of_more_clips_than_windows_each_gives_one_at_most(make_clip: ClipMaker):
    """Of 24 clips at one level 16 distinct ones, of 16 all in their order."""
    clips = [make_clip()] * 24
    many, few = (Windows(some, WindowSettings(crop=16), fixed=True) for some in (clips, clips[:16]))
    assert len({many.place(n).clip for n in many.spread(16)}) == 16
    assert few.spread(16) == list(range(16))


def test_clips_that_hold_no_window_are_named(make_clip: ClipMaker):
    needs = "clip short is 5 x 36 x 44; a window needs 11 frames of 16 x 16 px; choose fewer frames=, or other clips"
    with pytest.raises(ValueError, match=needs):
        Windows([make_clip("short", frames=5)], WindowSettings(crop=16))
    with pytest.raises(ValueError, match="choose a smaller crop=, or other clips"):
        Windows([make_clip("small", frames=11)], WindowSettings(crop=40))
    with pytest.raises(ValueError, match="no complete clip"):
        Windows([], WindowSettings())


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (Illumination.of(ppp=None, lux=10.0), "photo: its radiance is relative .* has no pixel size, which lux need"),
        (
            Illumination.of(diffraction=True),
            "photo: diffraction needs a camera, .*; leave its data set out, or sense the other",
        ),
    ],
    ids=["lux", "diffraction"],
)
def test_noise_must_fit_clips_with_and_without_a_camera(make_clip: ClipMaker, noise: Illumination, message: str):
    clips = [make_clip("lit"), make_clip("photo", relative=True)]
    for order in (clips, clips[::-1]):
        with pytest.raises(ValueError, match=message):
            Windows(order, WindowSettings((noise,), crop=16))


def test_a_defect_map_must_cover_clips_of_every_size(make_clip: ClipMaker, tmp_path):
    np.save(tmp_path / "dead.npy", np.eye(36, 44, dtype=bool))
    light = Illumination.of(sensor_file(tmp_path, QIS + 'dead_map = "dead.npy"\n', 3), 3.0, 3)
    with pytest.raises(ValueError, match="a map must cover the frames"):
        Windows([make_clip(), make_clip("tall", height=40)], WindowSettings((light,), crop=16))


def test_the_pattern_moves():
    """The fixture itself: frame t is frame 0 shifted by 1.5 px per frame, away from the disk's wrap-around."""
    clip = sliding_pattern(5, 36, 44, seed=0)
    assert np.abs(clip[2][:, 3:] - clip[0][:, :-3]).mean() < 0.02 < np.abs(clip[2] - clip[0]).mean()


def test_bad_radiance_names_its_clip(make_clip: ClipMaker, monkeypatch):
    """A damaged file may hold NaN: both ways to codes name the clip and the frames."""
    clip = make_clip()
    monkeypatch.setattr(type(clip), "radiance", lambda self, t, crop=None: np.full((36, 44), np.nan, np.float32))
    with pytest.raises(ValueError, match=r"sliding_0: frames 2\.\.3: photons"):
        sensed(clip, Illumination())[0].read(2, 4)
    with pytest.raises(ValueError, match=r"sliding_0: window from code \d: photons"):
        Windows([clip], WindowSettings(crop=36))[0]


def test_one_call_takes_streams_clips_and_folders(make_clip: ClipMaker, tiny_dataset):
    clip = make_clip(sharp=True)
    stream = clip.sense("spad-320x240", bits=1, ppp=1.5)
    clip.sense("quiver-paper", bits=3, ppp=9.0)
    expected = Windows([clip], WindowSettings((Illumination.of("spad-320x240", 1.5, 1),), crop=16, seed=4), repeats=3)
    found = windows(stream, crop=16, seed=4, repeats=3)
    assert len(found) == 3
    assert all(same(found[n], expected[n]) for n in range(5))
    both = Windows([clip], WindowSettings(crop=16, frames=7))
    for source in (clip, [clip], clip.path, str(clip.path)):
        assert same(windows(source, crop=16, frames=7)[1], both[1])
    part = windows(tiny_dataset, split="train", crop=16)
    assert [c.name for c in part.clips] == [c.name for c in open_clips(tiny_dataset, "train")]
    with pytest.raises(ValueError, match="split= is for the folder of a data set"):
        windows(clip, split="train")


def test_a_plain_loader_batches_and_shuffles_windows(make_clip: ClipMaker):
    data = windows(make_clip(), crop=16, repeats=4)
    batches = list(DataLoader(data, batch_size=2, shuffle=True, generator=torch.Generator().manual_seed(0)))
    assert [batch["codes"].shape for batch in batches] == [(2, 11, 1, 16, 16)] * 2
    assert sorted(int(n) for batch in batches for n in batch["sample"]) == [0, 1, 2, 3]


@pytest.mark.parametrize("file", ["quiver/__init__.py", "quiver/data/windows.py", "docs/examples/pytorch.py"])
def test_loaders_of_the_pages_draw_new_noise_in_every_epoch(file: str):
    """A loader that is given no numbers repeats those of the first epoch: pages and docstrings give it `Batches`."""
    made = [line for line in (ROOT / file).read_text().splitlines() if "DataLoader(" in line]
    assert len(made) == 1
    assert "batch_sampler=Batches(8, first=0, last=" in made[0]


@pytest.mark.parametrize("reverse", [False, True])
def test_a_scene_at_rest_has_no_motion_blur(make_clip: ClipMaker, reverse):
    """Codes of a bright scene, nearly free of noise, equal the centre frame of the target and not the exposed one."""
    clip = make_clip(sharp=True)
    light = Illumination.of(sensor="quiver-physical", ppp=2e4, bits=14)
    data = Windows([clip], WindowSettings(lights=(light,), crop=16, reverse=reverse, drift=2, still=True, seed=3))
    for n in range(6):
        sample = data[n]
        sensor = light.device(clip.exposure)
        white = float(sample["white"])
        found = sensor.response(clip.exposure).invert(sample["still"].mean(0)[0].numpy() * (sensor.levels - 1), 11)
        target = sample["target"][5, 0].numpy() * white
        assert np.abs(found / target - 1).max() < 6 / np.sqrt(11 * 0.5 * target.min())  # the exposed frame: 0.1


@pytest.mark.parametrize(("least", "advice"), [(11, "give clips of 11 frames or more"), (1, "choose fewer frames=")])
def test_the_advice_for_short_clips_can_be_followed(make_clip: ClipMaker, least, advice):
    with pytest.raises(ValueError, match=f"a window needs 11 frames .*; {advice}"):
        Windows([make_clip(frames=8)], WindowSettings(crop=16, least=least))


def test_windows_can_be_listed(make_clip: ClipMaker):
    """The loop never ended."""
    data = three_clips(make_clip)
    assert len(list(data)) == len(data) == 6


@pytest.mark.parametrize("length", [1, 7, 8, 9, 23, 64, 65])
def test_a_long_epoch_holds_every_window_once_and_spreads_each_part(length: int, monkeypatch: pytest.MonkeyPatch):
    """As one permutation where it is short; else parts of 8, each from all over the set."""
    whole = np.random.default_rng((3, 1)).permutation(length).tolist()
    monkeypatch.setattr(sys.modules[Windows.__module__], "SHUFFLED", 8)
    found = [shuffled(length, (3, 1), index) for index in range(length)]
    assert sorted(found) == list(range(length))
    if length <= 8:
        assert found == whole
    else:
        parts = -(-length // 8)
        assert all(max(found[i : i + 4]) - min(found[i : i + 4]) >= parts for i in range(0, length - 8, 8))
        assert found != [shuffled(length, (3, 2), index) for index in range(length)]


def test_no_more_clips_stay_open_than_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.modules[Windows.__module__], "KEPT", 2)
    clips = [write_clip(tmp_path / f"{i}", frames=3, height=8, width=8) for i in range(5)]
    data = Windows(clips, WindowSettings(frames=3, crop=8), repeats=3)
    drawn = [data[n]["key"] for n in range(len(data))]
    assert len(set(drawn)) == 15
    assert len(data._opened) <= 2
    assert len(data._draws) <= 2
