"""Tests concurrent sensing and reading of a clip: one writer at a time, and no reader mixes two streams."""

from __future__ import annotations

import hashlib
import io
import multiprocessing
import random
import time
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim.streams import stream
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from qsim.streams.stream_info import stored_settings

FORK = multiprocessing.get_context("fork")  # everything is imported already: the processes start together


def checksum(codes: np.ndarray) -> str:
    """Return the SHA-256 of the .npy file of packed codes."""
    file = io.BytesIO()
    np.save(file, codes)
    return hashlib.sha256(file.getvalue()).hexdigest()


def sense_again(path: Path, seed: int, seconds: float, answers: multiprocessing.Queue) -> None:
    """Replace and read the stream `same` repeatedly; half of the reads follow at once, half after a delay."""
    clip = Clip.open(path)
    rng = random.Random(seed)
    found = Counter[str]()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if seed < 4:
            made, _ = sense(clip, Sensing("quiver-physical", 3, 3.25, seed=seed, name="same"), force=True)
            found["made"] += made.info.seed == seed
        try:
            opened = clip.stream("same")
            time.sleep(rng.choice([0, 0.001, 0.01]))
            content = checksum(opened.packed)
            time.sleep(rng.choice([0, 0.01]))
            found["intact" if content == opened.info.sha256 == checksum(opened.packed) else "mixed"] += 1
        except ValueError as error:
            found["replaced" if "was replaced since it was opened" in str(error) else str(error)] += 1
        except FileNotFoundError:
            found["absent"] += 1
    answers.put(found)


def together(target, arguments: list[tuple]) -> list:
    """Return the answers of processes that start together; the queue is their last argument."""
    answers = FORK.Queue()
    workers = [FORK.Process(target=target, args=(*given, answers)) for given in arguments]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # fork in a process with threads, from Python 3.12 on
        for process in workers:
            process.start()
    found = [answers.get(timeout=120) for _ in workers]
    for process in workers:
        process.join()
    return found


@pytest.mark.parametrize("seconds", [2.0, pytest.param(30.0, marks=pytest.mark.slow)])
def test_no_reader_sees_codes_of_another_seed_than_its_json(tmp_path: Path, seconds: float):
    """Four processes replace a stream, four read it."""
    path = write_clip(tmp_path / "c", frames=3).path
    sense(Clip.open(path), Sensing("quiver-physical", 3, 3.25, name="same"))
    found = sum(together(sense_again, [(path, seed, seconds) for seed in range(8)]), Counter[str]())
    assert set(found) <= {"made", "intact", "replaced", "absent"}, found
    assert found["intact"] > 20, found
    assert found["replaced"] + found["absent"] > 0, "nothing was ever replaced beside a reader"
    assert Clip.open(path).verify() == []
    assert sorted(item.name for item in (path / "streams").iterdir()) == ["same.json", "same.npy"]


def sense_first(path: Path, start: float, answers: multiprocessing.Queue) -> None:
    """Sense a stream at the same time as the other processes."""
    clip = Clip.open(path)
    waits = []
    drawn = []
    time.sleep(max(0.0, start - time.monotonic()))
    try:
        made, _ = sense(
            clip,
            Sensing("quiver-physical", 3, 3.25),
            progress=lambda done, total: drawn.append(done),
            on_wait=lambda: waits.append(1),
        )
        answers.put((made.info.sha256, checksum(made.packed), bool(drawn), len(waits)))
    except BaseException as error:
        answers.put(repr(error))


def test_eight_processes_that_sense_a_new_stream_draw_it_once(tmp_path: Path):
    for n in range(5):
        path = write_clip(tmp_path / f"c{n}", frames=3).path
        found = together(sense_first, [(path, time.monotonic() + 0.3)] * 8)
        assert all(isinstance(one, tuple) for one in found), found
        assert {one[:2] for one in found} == {(found[0][0], found[0][0])}
        assert [one[2] for one in found].count(True) == 1, "one process draws, the others open its stream"
        assert all(one[3] <= 1 for one in found)


def test_a_replaced_stream_is_reported_and_a_mapped_one_stays(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=3)
    wanted = [Sensing("quiver-physical", 3, 3.25, seed=seed, name="same") for seed in (1, 2)]
    first, _ = sense(clip, wanted[0])
    mapped = clip.stream("same")
    unread = clip.stream("same")
    before = mapped.codes()
    second, _ = sense(clip, wanted[1], force=True)
    np.testing.assert_array_equal(mapped.codes(), before)
    with pytest.raises(ValueError, match=r"same\.json: was replaced since it was opened; open the stream again"):
        unread.codes()
    assert "was replaced" in unread.verify()[0]
    assert (second.codes() != before).any()
    sense(clip, wanted[0], force=True)
    np.testing.assert_array_equal(first.codes(), before)  # the same codes again: nothing was mixed


def test_failed_sensing_keeps_the_old_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The old stream stays complete until the new one is on the disk."""
    clip = write_clip(tmp_path / "c", frames=3)
    wanted = Sensing("quiver-physical", 3, 3.25, name="same")
    old, _ = sense(clip, wanted)
    blocks = iter([old.packed[:1]])
    with pytest.raises(ValueError, match="got 1 frames, expected 3"):
        stream.write_packed(clip.path / "streams" / "same.npy", blocks, old.info)
    assert clip.verify() == []
    assert clip.stream("same").info == old.info


def test_two_light_levels_share_their_random_numbers_and_another_seed_does_not(tmp_path: Path):
    """At 3.25 and 4 PPP and 3 bits, the correlation is 0.96 (docs/datasets.md); with another seed 0 within 5 sigma.

    0.01 is half a unit of the last digit and 5 sigma = 5 (1 - 0.96^2) / sqrt(8192) = 0.0043.
    """
    light = np.ones((2, 64, 64))
    clip = write_clip(tmp_path / "c", radiance=light)

    def noise(ppp: float, seed: int = 0) -> np.ndarray:
        wanted = Sensing("quiver-physical", 3, ppp, seed=seed)
        return sense(clip, wanted)[0].codes().astype(float).ravel()

    low = noise(3.25)
    high = noise(4.0)
    other = noise(4.0, seed=1)
    assert np.corrcoef(low, high)[0, 1] == pytest.approx(0.96, abs=0.01)
    assert abs(np.corrcoef(low, other)[0, 1]) < 5 / np.sqrt(light.size)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seed": -1}, "seed: expected a whole number from 0 to 2147483647, got -1"),
        ({"seed": 2**31}, "seed: expected a whole number from 0 to 2147483647, got 2147483648"),
        ({"bits": 17}, "bits: expected a whole number from 1 to 16, got 17"),
        ({"slices": 0}, "slices: expected a whole number from 1 to 100000, got 0"),
        ({"ppp": 0.0}, "ppp: expected a number from 1e-06 to 1e\\+06, got 0.0"),
        ({"ppp": 3.25, "lux": 1.0}, "give the light level as ppp or as lux, not both"),
        ({"group": True, "slices": 2}, "group sums planes, slices are of one exposure; give one of them"),
        ({"planes": 7, "slices": 2}, "slices: are of one exposure, and planes=7 are exposed one by one; give one of"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_a_clip_is_read(settings: dict, message: str):
    with pytest.raises(ValueError, match=message):
        Sensing("quiver-physical", **settings)


@pytest.mark.parametrize(
    ("sensor", "settings"),
    [
        ("spad-320x240", {"bits": np.int64(2), "group": np.bool_(True), "ppp": np.float32(3.25)}),
        ("quiver-paper", {"bits": np.uint8(3), "slices": np.int64(2), "lux": np.float32(2.5), "seed": np.int64(4)}),
    ],
)
def test_numbers_of_numpy_are_those_of_python(tmp_path: Path, sensor: str, settings: dict):
    """Codes and description are equal to the byte."""
    clip = write_clip(tmp_path / "c", frames=7, height=8, width=9)

    def written(given: dict) -> tuple[str, bytes, bytes]:
        path = clip.sense(sensor, **given, force=True).path
        return path.name, path.read_bytes(), path.with_suffix(".json").read_bytes()

    assert written(settings) == written({name: value.item() for name, value in settings.items()})


@pytest.mark.parametrize("planes", [1, 2, 5, 7, 10])
def test_codes_of_any_number_of_planes_are_sums_of_single_planes(tmp_path: Path, planes: int):
    """Each clip frame is a plane of its own, and a code of n planes is drawn with their random numbers."""
    clip = write_clip(tmp_path / "c", frames=21, height=6, width=9)
    file = tmp_path / "spad.toml"
    file.write_text('[sensor]\nmodel = "BinarySPAD"\nbits = 1\npde = 0.5\ndark_count_rate = 100.0\n')
    single = clip.sense(file, ppp=0.8, name="single")
    summed = clip.sense(file, ppp=0.8 * planes, planes=planes, name="summed")
    assert summed.sensor.levels == planes + 1
    assert len(summed) == 21 // planes
    assert clip.sense(file, ppp=0.8 * planes, planes=planes, name="summed").info == summed.info
    expected = single[: 21 // planes * planes].reshape(-1, planes, 6, 9).sum(axis=1)
    np.testing.assert_array_equal(summed[:], expected)


def test_planes_state_the_bits_of_their_sum(tmp_path: Path):
    with pytest.raises(ValueError, match="planes=10: their sum has 4 bits, not 3"):
        Sensing("spad-320x240", bits=3, planes=10)
    with pytest.raises(ValueError, match="give one of them"):
        Sensing("spad-320x240", planes=10, slices=2)
    with pytest.raises(ValueError, match="planes= is for a clocked SPAD"):
        write_clip(tmp_path / "c", frames=21, height=6, width=9).sense("quiver-physical", ppp=3, planes=10)


def test_planes_and_group_exclude_each_other():
    """`planes` alone sums; the settings that a stream states are those of `group`, as it has the planes itself."""
    with pytest.raises(ValueError, match=r"group: sums 2\^bits - 1 planes, planes=10 sums others; leave it out"):
        Sensing("spad-320x240", planes=10, group=True)
    sensing = Sensing("spad-320x240", planes=10)
    assert replace(sensing, ppp=2.0).summed
    assert stored_settings(sensing) == {"group": True}
