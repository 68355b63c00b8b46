"""Tests the writing of clips: interruptions at every step, other settings, two writers, refusals."""

import functools
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forks import killed_at
from tiny_clip import FRAMES, HEIGHT, WIDTH, meta, radiance, write

from qsim import records
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip


def interrupted(path: Path, *frames: int, force: bool = False, **changes: Any) -> list[int]:
    """Stop a writer after some frames; return the frames that it found finished."""
    found: list[int] = []
    try:
        with ClipWriter(path, meta(**changes), force=force) as writer:
            found += [t for t in range(FRAMES) if writer.has(t)]
            for t in frames:
                writer.add(t, radiance(t))
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        return found


def test_an_interrupted_writer_leaves_no_clip_and_resumes(tmp_path: Path):
    path = tmp_path / "a"
    interrupted(path, 1, 0)
    with pytest.raises(FileNotFoundError, match=r"unfinished \(only a.part is there\)"):
        Clip.open(path)
    # Killed within a journal line and a temporary file.
    with open(tmp_path / "a.part" / "journal.jsonl", "ab") as journal:
        journal.write(b'{"t": 2, "che')
    with ClipWriter(path, meta()) as writer:
        assert [t for t in range(FRAMES) if writer.has(t)] == [0, 1]
        for t in range(2, FRAMES):
            writer.add(t, radiance(t))
    whole = tmp_path / "b" / "a"
    with ClipWriter(whole, meta()) as writer:
        for t in range(FRAMES):
            writer.add(t, radiance(t))
    assert (path / "clip.json").read_bytes() == (whole / "clip.json").read_bytes()
    assert not (tmp_path / "a.part").exists()
    assert sorted(p.name for p in path.iterdir()) == ["clip.json", "radiance"]


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("left", "replaced", "force"),
    [
        (None, False, False),
        ({}, False, False),
        ({}, False, True),
        ({"frame_rate": 1000.0}, False, True),
        ({}, True, True),
    ],
)
def test_a_writer_killed_at_any_step_can_start_again(
    tmp_path: Path, left: dict[str, Any] | None, replaced: bool, force: bool, every: int
):
    """Killed before each open, removal and rename: in an empty folder, resuming, clearing, replacing a clip.

    The quick test takes every ninth of them, and begins at another one for each case.
    """
    killed = True
    steps = (every - 1) * (2 * replaced + force + (left is None)) // 4
    while killed:
        path = tmp_path / str(steps) / "a"
        path.parent.mkdir()
        if replaced:
            write(path, frame_rate=500.0)
        if left is not None:
            interrupted(path, 0, force=force, **left)
        steps += every
        killed = killed_at(steps, path, functools.partial(write, path, force=force))
        if not path.exists() or Clip.open(path).frame_rate == 500.0:
            write(path, force=force)
        clip = Clip.open(path)
        assert (clip.frame_rate, clip.verify()) == (2000.0, [])
        assert [item.name for item in path.parent.iterdir()] == ["a"]
        assert sorted(item.name for item in path.iterdir()) == ["clip.json", "radiance", "sharp", "truth"]
    assert steps > 50


@pytest.mark.parametrize("gone", [(), ("begun.json",), ("begun.json", "journal.jsonl"), ("begun.json", "lock")])
def test_a_clip_that_only_lacks_the_rename_is_not_made_again(tmp_path: Path, monkeypatch, gone: tuple[str, ...]):
    """Killed after clip.json was written: all frames are kept, and other settings are refused."""
    part = tmp_path / "a.part"

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda a, b: killed() if Path(a) == part else os.rename(a, b))
        patch.setattr(Path, "unlink", lambda self, **_: os.remove(self) if self.name in gone else None)
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "a")
    frame = part / "radiance" / "000000.exr"
    made = frame.stat().st_ino
    kept = frame.read_bytes()
    with pytest.raises(ValueError, match=r"a\.part: 5 frames exist, begun with other settings"):
        write(tmp_path / "a", shape=[FRAMES - 1, HEIGHT, WIDTH])
    assert interrupted(tmp_path / "a") == list(range(FRAMES))
    clip = write(tmp_path / "a")
    assert clip.verify() == []
    assert (clip.path / "radiance" / "000000.exr").stat().st_ino == made
    assert records.plain(clip.info) == records.plain(write(tmp_path / "b" / "a").info)
    clip.path.rename(part)
    frame.write_bytes(kept[:-1])  # a damaged clip does not count as complete
    assert interrupted(tmp_path / "a") == []


def test_a_damaged_frame_of_an_interrupted_writer_is_written_again(tmp_path: Path):
    interrupted(tmp_path / "a", 0)
    frame = tmp_path / "a.part" / "radiance" / "000000.exr"
    frame.write_bytes(frame.read_bytes()[:-1])
    assert interrupted(tmp_path / "a") == []


def test_other_settings_are_refused_or_start_again(tmp_path: Path):
    interrupted(tmp_path / "a", 0)
    assert interrupted(tmp_path / "a", 1) == [0]
    with pytest.raises(ValueError, match=r"a\.part: 2 frames exist, begun with other settings"):
        interrupted(tmp_path / "a", frame_rate=1000.0)
    assert interrupted(tmp_path / "a") == [0, 1]
    assert interrupted(tmp_path / "a", force=True, frame_rate=1000.0) == []


def test_two_writers_of_one_clip(tmp_path: Path):
    with ClipWriter(tmp_path / "a", meta()) as writer:
        writer.add(0, radiance(0))
        with pytest.raises(ValueError, match="another process is writing"), ClipWriter(tmp_path / "a", meta()):
            pass
        for t in range(1, FRAMES):
            writer.add(t, radiance(t))
    assert Clip.open(tmp_path / "a").verify() == []


def test_nothing_is_overwritten_without_force(tmp_path: Path):
    write(tmp_path / "a")
    with pytest.raises(FileExistsError, match="force=True"):
        ClipWriter(tmp_path / "a", meta())
    with ClipWriter(tmp_path / "a", meta(), force=True) as writer:
        for t in range(FRAMES):
            writer.add(t, radiance(t) + 1)
    clip = Clip.open(tmp_path / "a")
    assert clip.mean_radiance > 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


@pytest.mark.parametrize("force", [False, True])
def test_what_appears_at_the_place_of_a_clip_meanwhile_is_not_deleted(tmp_path: Path, force: bool):
    """It is refused when the clip is complete; moved away, the same command only renames."""
    path = tmp_path / "a"
    if force:
        write(path)
    writer = ClipWriter(path, meta(), force=force).__enter__()
    for t in range(FRAMES):
        writer.add(t, radiance(t))
    path.mkdir(exist_ok=True)
    (path / "notes.txt").write_text("mine")
    told = r"notes\.txt: was not made by" if force else r"a: appeared while .* is complete in a\.part; move it away"
    with pytest.raises(FileExistsError, match=told):
        writer.__exit__(None, None, None)
    assert (path / "notes.txt").read_text() == "mine"
    path.rename(tmp_path / "mine")
    with ClipWriter(path, meta(), force=force) as again:
        assert all(again.has(t) for t in range(FRAMES))
    assert Clip.open(path).verify() == []


def test_files_and_other_folders_are_never_replaced(tmp_path: Path):
    """Neither a folder, nor a file, nor a folder of another origin with the name of the temporary one."""
    (tmp_path / "thesis").mkdir()
    for path in (tmp_path / "thesis" / "a.txt", tmp_path / "b", tmp_path / "c.part" / "notes.txt"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("years of work")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for name in ("thesis", "b"):
        with pytest.raises(FileExistsError, match="exists and is not a clip"):
            ClipWriter(tmp_path / name, meta(), force=True)
    with pytest.raises(ValueError, match=r"c\.part: was not written by qsim"):
        ClipWriter(tmp_path / "c", meta()).__enter__()
    left = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.name != "lock"}
    assert left == before


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3])
def test_impossible_radiance_is_named_and_leaves_nothing(tmp_path: Path, value: float):
    image = radiance(0).copy()
    image[4, 3] = value
    with pytest.raises(ValueError, match=r"radiance of frame 0 is .* at \(y, x\) = \(4, 3\)"):  # noqa: SIM117
        with ClipWriter(tmp_path / "a", meta()) as writer:
            writer.add(0, image)
    assert list(tmp_path.iterdir()) == []


def test_a_number_that_no_reader_takes_is_refused_before_the_first_frame(tmp_path: Path):
    with pytest.raises(ValueError, match="more than 64 bits"):
        ClipWriter(tmp_path / "a", meta() | {"source": {"format": "zarr", "attributes": {"fps": 2**255}}})
    assert list(tmp_path.iterdir()) == []


def test_a_missing_frame_is_not_a_clip(tmp_path: Path):
    writer = ClipWriter(tmp_path / "a", meta()).__enter__()
    for t in (0, 1, 2, 4):
        writer.add(t, radiance(t))
    with pytest.raises(ValueError, match=r"frame 3 was never written \(1 of 5"):
        writer.__exit__(None, None, None)
    with pytest.raises(FileNotFoundError):
        Clip.open(tmp_path / "a")


def test_light_too_small_for_half_floats_is_refused_and_can_be_scaled(tmp_path: Path):
    """Values of 1e-8 would become 0, and values of 1e-6 have 17 levels; one bright frame is enough."""

    def write_light(name: str, largest: float, others: float) -> Clip:
        with ClipWriter(tmp_path / name, meta()) as writer:
            for t in range(FRAMES):
                writer.add(t, np.full((HEIGHT, WIDTH), largest if t == 1 else others, np.float32))
        return Clip.open(tmp_path / name)

    for largest in (1e-8, 1e-6, 1.5e-5):
        with pytest.raises(ValueError, match=rf"its largest light is {largest:.3g}, .* 256 steps; multiply"):
            write_light("a", largest, largest / 2)
        assert list(tmp_path.iterdir()) == []  # the same settings with other light start again
    assert write_light("a", 1.6e-5, 1e-9).radiance(1).max() == pytest.approx(1.6e-5, rel=2e-3)
    assert write_light("dark", 0.0, 0.0).mean_radiance == 0.0


def test_the_stated_error_holds_the_rounding_to_halves(tmp_path: Path):
    """A frame of one value, known without error, was stated with an error of 0; stored it is 0.70019531."""
    flat = np.full((HEIGHT, WIDTH), 0.7)
    with ClipWriter(tmp_path / "a", meta(shape=[1, HEIGHT, WIDTH])) as writer:
        writer.add(0, flat, error=0.0, errors_at=[(0.5, 0.0), (2.0, 3e-4)])
        entry = writer._frames[0]
    lost = abs(float(np.float16(0.7)) - 0.7)
    assert lost > 1e-4
    assert entry.error == pytest.approx(lost)
    assert entry.errors_at == (pytest.approx((0.5, lost)), pytest.approx((2.0, np.hypot(3e-4, lost))))
