"""Windows that are drawn on a device: those of the host to the bit, without a question to the device."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from clips import ClipMaker
from sensor_files import QIS as QIS_FILE
from sensor_files import SPAD, sensor_file
from torch.utils.data import DataLoader, default_collate
from waiting import listed_waits

from qsim import Camera, keys
from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern
from qsim.sensor.qis import QIS
from quiver.data import device_light, numpy_sums
from quiver.data import windows as drawing
from quiver.data.code_table import draw_codes
from quiver.data.device_filling import Fills, fill_of
from quiver.data.device_light import Unfit, _law_of, size_of
from quiver.data.device_windows import SPARE, DeviceWindows
from quiver.data.device_words import uniform, words
from quiver.data.illumination import Illumination
from quiver.data.mosaic_windows import filled_windows, turned_frame
from quiver.data.sensor_of_window import seen_by
from quiver.data.windows import STAY, Batches, Windows, WindowSettings
from quiver.training.system import collated

CPU = torch.device("cpu")
PLENTY = 10**9  # bytes
LIGHTS = (
    Illumination.of(ppp=3.25),
    Illumination.of(ppp=0.3),
    Illumination.of("quiver-published", ppp=26.0, bits=5),
    Illumination.of("spad-320x240", ppp=1.0, bits=1),
    Illumination.of("spad-320x240", ppp=4.9, bits=3),
    Illumination.of(ppp=100.0, bits=7),
)


def some_clips(make_clip: ClipMaker) -> list[Any]:
    """Clips of several sizes, with and without sharp frames, a camera and vignetting."""
    wide = {"camera": vars(Camera(2e-3, 1.8, 3.2e-6, 40, 52, vignetting=True))}
    return [
        make_clip("plain", seed=0),
        make_clip("sharp", seed=1, sharp=True, height=40, width=37),
        make_clip("relative", seed=2, relative=True, frames=17),
        make_clip("dark", seed=3, height=40, width=52, **wide, sharp=True),
        make_clip("crop", seed=4, height=36, width=44, **wide, origin=[4, 8]),
    ]


def same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Compare two batches, to the bit."""
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        if isinstance(value, torch.Tensor):
            assert found[name].dtype == value.dtype, name
            assert torch.equal(found[name].cpu(), value), name
        else:
            assert found[name] == value, name


@pytest.mark.parametrize("seed", range(6))
def test_windows_of_a_device_are_those_of_the_host(make_clip: ClipMaker, seed: int):
    """Random settings: sizes, turns, drift, sensors, light, ceilings, one clip or several."""
    rng = np.random.default_rng(seed)
    clips = some_clips(make_clip)
    lights = tuple(LIGHTS[i] for i in rng.permutation(len(LIGHTS))[: rng.integers(1, 4)])
    settings = WindowSettings(
        lights=lights,
        frames=int(rng.integers(1, 13)),
        crop=int(rng.integers(1, 34)),
        flips=bool(rng.integers(2)),
        reverse=bool(rng.integers(2)),
        drift=int(rng.integers(4)),
        ceiling=float(rng.uniform(0.3, 4)),
        force_exposure=bool(rng.integers(2)),
        seed=seed,
    )
    chosen = [clips[i] for i in rng.permutation(len(clips))[: rng.integers(1, 6)]]
    windows = Windows(chosen, settings, repeats=3)
    device = DeviceWindows(windows, CPU, PLENTY)
    for _ in range(3):
        numbers = [int(n) for n in rng.integers(0, 10**6, rng.integers(1, 6))]
        found = device.draw(default_collate([device.places[n] for n in numbers]))
        same(found, default_collate([windows[n] for n in numbers]))


def test_every_turn_and_light_occurs(make_clip: ClipMaker):
    """The windows above are all kinds: eight turns, both directions, drifts, lights."""
    settings = WindowSettings(lights=LIGHTS, crop=12, drift=2)
    windows = Windows(some_clips(make_clip), settings)
    device = DeviceWindows(windows, CPU, PLENTY)
    numbers = list(range(160))
    places = [windows.place(n) for n in numbers]
    assert len({(place.turn, place.backwards, place.drift != (0, 0)) for place in places}) == 32
    assert {place.light for place in places} == set(range(len(LIGHTS)))
    same(
        device.draw(default_collate([device.places[n] for n in numbers])),
        default_collate([windows[n] for n in numbers]),
    )


@pytest.mark.parametrize("pool", [1, 3, 7])
def test_a_pool_of_clips_turns_over_alike_on_host_and_device(make_clip: ClipMaker, monkeypatch, pool: int):
    """Batch after batch, from another place on, and far away; a pool may be larger than the data set."""
    monkeypatch.setattr(drawing, "STAY", 5)
    monkeypatch.setattr("quiver.data.device_windows.STAY", 5)
    clips = some_clips(make_clip)
    windows = Windows(clips, WindowSettings(crop=8, frames=3, pool=pool, lights=LIGHTS[:2]))
    device = DeviceWindows(windows, CPU, PLENTY)
    assert len(device.held.light) == (pool + SPARE) * max(size_of(clip) for clip in clips)
    for start in (*range(0, 60, 6), *range(33, 60, 6), 10**6):
        numbers = range(start, start + 6)
        found = device.draw(default_collate([device.places[n] for n in numbers]))
        same(found, default_collate([windows[n] for n in numbers]))
    with pytest.raises(ValueError, match="more than 20 windows from first to last"):
        device.draw(default_collate([device.places[n] for n in (0, 40)]))


def test_every_clip_of_a_pool_stays_and_leaves(make_clip: ClipMaker):
    """A sample draws one of `pool` clips; each of all clips comes equally often, and stays for pool * STAY samples."""
    clips = [make_clip(f"c{i}", seed=i) for i in range(4)]
    windows = Windows(clips, WindowSettings(crop=8, pool=2, seed=3))
    positions = [windows.position_of(n) for n in range(40 * STAY)]
    for n, position in enumerate(positions):
        assert n // STAY <= position < n // STAY + 2
    assert {windows.clip_at(position) for position in range(4)} == {0, 1, 2, 3}
    counts = np.bincount([windows.clip_of(n) for n in range(40 * STAY)])
    assert np.ptp(counts) < 0.25 * counts.mean()
    with pytest.raises(ValueError, match="pool must be at least 1, got 0"):
        WindowSettings(pool=0)


def test_a_loader_of_places_draws_the_batches_of_a_loader_of_windows(make_clip: ClipMaker):
    windows = Windows(some_clips(make_clip), WindowSettings(crop=16))
    device = DeviceWindows(windows, CPU, PLENTY)
    batches = Batches(3, 2, 5)
    loaded = zip(
        DataLoader(device.places, batch_sampler=batches), DataLoader(windows, batch_sampler=batches), strict=True
    )
    for places, wanted in loaded:
        same(device.draw(places), wanted)


def test_words_are_those_of_the_keys():
    """Of every size up to two blocks of columns, of two redraws, under keys of all bits."""
    rng = np.random.default_rng(0)
    for _ in range(12):
        shape = tuple(int(n) for n in rng.integers(1, 10, 3))
        some = [Key(int(rng.integers(100)), int(n), stage=1) for n in rng.integers(0, 1 << 40, 2)]
        halves = torch.tensor([divmod(key.philox_key, 1 << 32) for key in some])
        found = words(*halves.unbind(1), shape, redraws=2)
        for i, key in enumerate(some):
            first, second = (keys.words(key, shape, redraw=r) for r in (0, 1))
            assert np.array_equal(found[i, 0].numpy(), first)
            assert np.array_equal(found[i, 1].numpy(), second)
            assert np.array_equal(uniform(*found[i]).numpy(), keys.uniform(first, second))


def test_sums_are_those_of_numpy():
    """Of rows of all lengths up to several halvings, and of those of windows."""
    rng = np.random.default_rng(5)
    for count in (*range(1, 40), *rng.integers(40, 5000, 60), 11 * 64 * 64, 21 * 30 * 30):
        rows = rng.exponential(1.0, (2, int(count)))
        assert np.array_equal(numpy_sums.total(torch.from_numpy(rows)).numpy(), [row.sum() for row in rows])
        assert np.array_equal(numpy_sums.mean(torch.from_numpy(rows)).numpy(), [row.mean() for row in rows])


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.label)
def test_a_million_codes_over_all_light_are_those_of_the_reference(make_clip: ClipMaker, light: Illumination):
    """Photons from none to far beyond the brightest, each drawn by the cubics and by `draw_codes`."""
    clip = make_clip()
    windows = Windows([clip], WindowSettings(lights=(light,), crop=4, frames=1))
    device = DeviceWindows(windows, CPU, PLENTY)
    sensor = windows.noise.noises[0].draw(clip).sensor
    white = sensor.white(clip.exposure)
    rng = np.random.default_rng(1)
    photons = white * 10.0 ** rng.uniform(-6, 2.5, (4, 500, 500))
    photons[0, :5] = 0
    key = Key(3, 4)
    halves = torch.tensor([divmod(key.philox_key, 1 << 32)])
    row = device.held.numbers[:, 4][:, None, None, None], device.held.integers[:, 6], device.held.integers[:, 7]
    drawn = words(*halves.unbind(1), photons.shape, redraws=2)
    found = device._codes(torch.from_numpy(photons)[None], *row, drawn)
    wanted = draw_codes(sensor, photons, clip.exposure, key)
    assert np.array_equal(found[0].numpy(), wanted)


def test_words_near_a_step_are_decided_by_64_bits(make_clip: ClipMaker):
    """Where the first word lies within its last digit of a step, the second decides, as in the reference."""
    clip = make_clip()
    windows = Windows([clip], WindowSettings(crop=4, frames=1))
    device = DeviceWindows(windows, CPU, PLENTY)
    sensor = windows.noise.noises[0].draw(clip).sensor
    rng = np.random.default_rng(2)
    photons = rng.uniform(0, 20, 4000)
    steps = sensor.cdf(photons, clip.exposure)[np.arange(4000), rng.integers(0, 7, 4000)]
    first = np.floor(steps * 2.0**32).clip(0, 2**32 - 1).astype(np.uint32)
    second = rng.integers(0, 2**32, 4000, dtype=np.uint64).astype(np.uint32)
    wanted = sensor.draw(photons, clip.exposure, first, lambda some: second[some])
    drawn = torch.from_numpy(np.stack([first, second]).astype(np.int64))[None, :, None, None]
    row = device.held.numbers[:, 4][:, None, None, None], device.held.integers[:, 6], device.held.integers[:, 7]
    found = device._codes(torch.from_numpy(photons)[None, None, None], *row, drawn)
    assert np.array_equal(found.flatten().numpy(), wanted)


@pytest.mark.parametrize("dead", [0.0, 0.1])
def test_a_batch_waits_for_nothing_whatever_its_size(make_clip: ClipMaker, dead: float):
    """On `meta`, where a look at a value is an error. The count of operators is that of launches, at most."""
    table = json.dumps(Defects(FixedPattern(dead=dead)).to_dict()) if dead else None
    lights = tuple(replace(light.stated(), defects=table) for light in LIGHTS[:4])
    settings = WindowSettings(lights=lights, crop=16, drift=2, force_exposure=True)
    windows = Windows(some_clips(make_clip), settings)
    device = DeviceWindows(windows, CPU, PLENTY)
    for name in ("light", "gains", "cubics", "pixels", "integers", "numbers"):
        setattr(device.held, name, getattr(device.held, name).to("meta"))
    device.turned = device.turned.to("meta")
    device.places_of_turns = device.places_of_turns.to("meta")
    device.device = torch.device("meta")
    counts = []
    for batch in (2, 64):
        place = torch.empty(batch, 10, dtype=torch.int64, device="meta")
        fills = fills_on_meta(batch) if dead else None
        with listed_waits() as (waits, operators):
            found = device.drawn(place, fills)
        assert found["codes"].shape == (batch, 11, 1, 16, 16)
        assert waits == []
        counts.append(operators.count)
    assert counts[0] == counts[1] < (500 if dead else 300)


def fills_on_meta(batch: int) -> Fills:
    """Return fills of windows of 16 x 16 px."""
    bad = np.random.default_rng(0).uniform(size=(batch, 16, 16)) < 0.1
    fills = Fills.of([fill_of(own, QIS(0.8, 1.6, 0.2, 3)) for own in bad], CPU)
    return Fills(**{name: value.to("meta") for name, value in vars(fills).items()})


FILES_OF_SENSORS = (SPAD, QIS_FILE, QIS_FILE.replace("read_noise", "gain = 2.5\nread_noise"))  # the last skips codes


def random_noises(rng: np.random.Generator, folder: Path) -> tuple[Illumination, ...]:
    """Return some lights: sensors of random bits, with random maps of gain, dark rate and dead pixels, or without."""
    noises = []
    for number in range(rng.integers(1, 4)):
        bits = int(rng.integers(1, 5))
        file = sensor_file(folder, FILES_OF_SENSORS[rng.integers(3)], bits, f"{number}.toml")
        light = Illumination.of(file, 3.0, bits).stated()
        pattern = FixedPattern(
            device_seed=int(rng.integers(100)),
            prnu=float(rng.choice([0.0, 0.2])),
            dark=DarkSpread() if rng.integers(2) else None,
            dead=float(rng.choice([0.0, 0.05, 0.6])),
        )
        defects = None if rng.integers(4) == 0 else json.dumps(Defects(pattern).to_dict())
        noises.append(replace(light, defects=defects))
    return tuple(noises)


def drawn_there(device: DeviceWindows, numbers: list[int]) -> dict[str, Any]:
    return device.draw(collated([device.places[n] for n in numbers]))


@pytest.mark.parametrize("seed", range(10))
def test_windows_with_defects_are_those_of_the_host(make_clip: ClipMaker, tmp_path: Path, seed: int):
    """Random maps, sensors that skip codes or not, drifts, turns, clips that are crops; filled pixels too."""
    rng = np.random.default_rng(seed)
    settings = WindowSettings(
        lights=random_noises(rng, tmp_path),
        frames=int(rng.integers(1, 8)),
        crop=int(rng.integers(5, 20)),
        drift=int(rng.integers(3)),
        force_exposure=bool(rng.integers(2)),
        seed=seed,
    )
    windows = Windows(some_clips(make_clip), settings, repeats=3)
    device = DeviceWindows(windows, CPU, PLENTY)
    for _ in range(3):
        numbers = [int(n) for n in rng.integers(0, 10**6, rng.integers(1, 6))]
        same(drawn_there(device, numbers), collated([windows[n] for n in numbers]))


@pytest.mark.parametrize("seed", range(6))
def test_windows_of_summed_planes_are_those_of_the_host(make_clip: ClipMaker, tmp_path: Path, seed: int):
    """Sums of several numbers of planes, with and without defects, beside codes of one exposure."""
    rng = np.random.default_rng(seed)
    sums = [Illumination.of("spad-320x240", ppp=2.0, bits=bits).over(2**bits - 1) for bits in (1, 2)]
    pattern = FixedPattern(prnu=0.2, dead=0.1, dark=DarkSpread())
    marked = replace(sums[1].stated(), defects=json.dumps(Defects(pattern).to_dict()))
    lights = (*sums, marked, LIGHTS[0])
    settings = WindowSettings(
        lights=tuple(lights[i] for i in rng.permutation(4)[: rng.integers(1, 5)]),
        frames=int(rng.integers(1, 5)),
        crop=int(rng.integers(5, 20)),
        drift=int(rng.integers(3)),
        force_exposure=bool(rng.integers(2)),
        seed=seed,
    )
    windows = Windows(some_clips(make_clip), settings, repeats=3, prepare=seen_by)
    device = DeviceWindows(windows, CPU, PLENTY)
    for _ in range(3):
        numbers = [int(n) for n in rng.integers(0, 10**6, rng.integers(1, 6))]
        same(drawn_there(device, numbers), collated([windows[n] for n in numbers]))


@pytest.mark.parametrize("good", [1, 3, 9, 60])
def test_pixels_with_few_good_neighbours_are_filled_as_on_the_host(good: int):
    """Of all turns, by means and by choices; also from less than eight pixels."""
    rng = np.random.default_rng(good)
    side = 12
    grid: Any = np.indices((side, side))
    for sensor in (QIS(0.8, 1.6, 0.2, 3), QIS(0.8, 1.6, 0.2, 4, 3.0)):
        codes = rng.integers(0, sensor.levels, (8, 5, side, side)).astype(np.uint8)
        maps = np.ones((8, side * side), bool)
        for each in maps:
            each[rng.permutation(side * side)[:good]] = False
        maps = maps.reshape(8, side, side)
        fills = Fills.of([fill_of(bad, sensor) for bad in maps], CPU)
        turned = np.stack([turned_frame(codes[turn], turn) for turn in range(8)]).astype(np.int64)
        places = np.stack([turned_frame(grid, turn) for turn in range(8)])
        at = torch.from_numpy((places[:, 0] * side + places[:, 1]).reshape(8, -1).argsort(axis=1))
        found = fills.applied(torch.from_numpy(turned), at).numpy()
        wanted = [turned_frame(filled_windows(codes[n], maps[n], sensor, (1, 1)), n) for n in range(8)]
        assert np.array_equal(found, np.stack(wanted))


def test_windows_state_the_sensor_that_saw_them(make_clip: ClipMaker, tmp_path: Path):
    """For networks whose inputs are made of a complete batch; behind defects, as on the host."""
    noises = (*LIGHTS[:3], *random_noises(np.random.default_rng(3), tmp_path))
    windows = Windows(some_clips(make_clip), WindowSettings(crop=8, lights=noises), prepare=seen_by)
    device = DeviceWindows(windows, CPU, PLENTY)
    numbers = list(range(20))
    found = drawn_there(device, numbers)
    assert len({seen.white for seen in found["sensors"]}) > 3
    same(found, collated([windows[n] for n in numbers]))


def unfit(problem: str, windows: Windows, memory: int = PLENTY) -> None:
    with pytest.raises(Unfit, match=problem):
        DeviceWindows(windows, CPU, memory)


def test_windows_that_no_device_draws_say_why(make_clip: ClipMaker, tmp_path: Path):
    clips = [make_clip("a"), make_clip("b", seed=1, sharp=True)]
    plain = WindowSettings(crop=16)
    unfit("copies at rest", Windows(clips, replace(plain, still=True)))
    unfit("computed where windows are drawn", Windows(clips, plain, prepare=lambda codes, n: {}))
    for table in (Defects(crosstalk=0.1), Defects(FixedPattern(offset=0.1))):
        light = replace(LIGHTS[3 if table.crosstalk else 0].stated(), defects=json.dumps(table.to_dict()))
        unfit("has crosstalk, afterpulses, or pixels with", Windows(clips, replace(plain, lights=(light,))))
    slices = LIGHTS[0].over(3)
    unfit("has codes of several slices", Windows(clips, replace(plain, frames=3, lights=(slices,))))
    late = LIGHTS[0].but(row_delay=1e-6)
    unfit("exposures that are late, unequal", Windows(clips, replace(plain, frames=3, lights=(late,))))
    unfit("their light is 0.000133 GB, and 0.0001 GB are for it", Windows(clips, plain), 100_000)
    unfit(r"and its laws are 0.00749 GB, and 0.0002 GB are for them", Windows(clips, plain), 200_000)


def test_laws_that_are_no_cubics_are_refused(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(Unfit, match="fall again with light"):
        _law_of(CountingSPAD(0.5, 200.0, 2e-5, 3, paralyzable=True), 5e-4)
    with pytest.raises(Unfit, match="codes of 8 bits have too many steps"):
        _law_of(CountingSPAD(0.5, 0.0, 0.0, 8), 5e-4)
    monkeypatch.setattr(device_light, "CELLS", 64)
    with pytest.raises(Unfit, match="are no cubics: they differ by"):
        _law_of(CountingSPAD(0.5, 0.0, 0.0, 4), 5e-4)
