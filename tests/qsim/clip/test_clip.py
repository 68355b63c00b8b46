"""Clip folders: what is written is read, and nothing that is not whole is accepted."""

import functools
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forks import killed_at

from qsim import files
from qsim.clip import exr
from qsim.clip.clip import Clip
from qsim.clip.manifest import PHYSICAL, RELATIVE
from qsim.clip.photons import clip_photons, light_level, light_line
from qsim.clip.writer import ClipWriter

FRAMES, HEIGHT, WIDTH = 5, 10, 7
CAMERA = {
    "kind": "Camera",
    "focal_length": 8e-3,
    "f_number": 2.8,
    "pixel_pitch": 1.1e-6,
    "height": HEIGHT,
    "width": WIDTH,
    "transmission": 0.9,
}


def meta(**changes: Any) -> dict[str, Any]:
    base = {
        "shape": [FRAMES, HEIGHT, WIDTH],
        "frame_rate": 2000.0,
        "shutter": 0.0,
        "exposure": 5e-4,
        "radiance_unit": PHYSICAL,
        "camera": CAMERA,
    }
    return base | changes


def radiance(t: int) -> np.ndarray:
    return np.random.default_rng(t).random((HEIGHT, WIDTH)).astype(np.float16).astype(np.float32)


def truth(t: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(100 + t)
    return {
        "flow": rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32),
        "flow_back": rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32),
        "valid": rng.random((HEIGHT, WIDTH)) < 0.8,
        "depth": np.where(rng.random((HEIGHT, WIDTH)) < 0.2, np.inf, 3.5).astype(np.float32),
        "body_id": rng.integers(-1, 4, (HEIGHT, WIDTH)).astype(np.int32),
    }


def write(path: Path, *, force: bool = False, **changes: Any) -> Clip:
    with ClipWriter(path, meta(**changes), force=force) as writer:
        for t in range(FRAMES):
            if not writer.has(t):
                sharp = radiance(50 + t) if t == 2 else None
                writer.add(t, radiance(t), sharp=sharp, truth=truth(t), error=0.01, fireflies=t)
    return Clip.open(path)


def interrupted(path: Path, *frames: int, force: bool = False, **changes: Any) -> list[int]:
    """A writer that is stopped after some frames; returns those which it found done."""
    found: list[int] = []
    try:
        with ClipWriter(path, meta(**changes), force=force) as writer:
            found += [t for t in range(FRAMES) if writer.has(t)]
            for t in frames:
                writer.add(t, radiance(t))
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        return found


def test_what_is_written_is_read(tmp_path: Path):
    clip = write(tmp_path / "a")
    assert len(clip) == FRAMES
    assert clip.shape == (FRAMES, HEIGHT, WIDTH)
    assert clip.exposure == 5e-4
    assert clip.name == "a"
    for t in range(FRAMES):
        np.testing.assert_array_equal(clip.radiance(t), radiance(t))
        np.testing.assert_array_equal(clip.sharp(t), radiance(50 + t) if t == 2 else radiance(t))
        for name, expected in truth(t).items():
            found = getattr(clip, name)(t)
            np.testing.assert_array_equal(found, expected)
            assert found.dtype == expected.dtype
    assert clip.mean_radiance == pytest.approx(np.mean([radiance(t) for t in range(FRAMES)]), rel=1e-6)
    assert clip.verify() == []
    assert clip.camera is not None
    assert clip.camera.f_number == 2.8


def test_crops_are_crops(tmp_path: Path):
    clip = write(tmp_path / "a")
    np.testing.assert_array_equal(clip.radiance(3, (2, 1, 5, 4)), clip.radiance(3)[2:7, 1:5])
    np.testing.assert_array_equal(clip.sharp(2, (9, 6, 1, 1)), clip.sharp(2)[9:, 6:])
    for crop in [(-1, 0, 2, 2), (0, 0, 0, 2), (6, 0, 5, 2), (0, 4, 2, 4)]:
        with pytest.raises(ValueError, match="is not inside 10 x 7"):
            clip.radiance(0, crop)
    with pytest.raises(ValueError, match=r"frame 5 asked for, the clip has frames 0\.\.4"):
        clip.radiance(5)


def test_photons_of_a_crop_are_the_crop_of_the_photons(tmp_path: Path):
    clip = write(tmp_path / "a")
    whole = clip_photons(clip, 1, 2.0)
    np.testing.assert_array_equal(clip_photons(clip, 1, 2.0, (3, 2, 4, 5)), whole[3:7, 2:7])
    level = light_level(clip, ppp=3.25)
    mean = np.mean([clip_photons(clip, t, level.factor).mean() for t in range(FRAMES)])
    assert mean == pytest.approx(3.25, rel=1e-12)


def test_light_levels(tmp_path: Path):
    clip = write(tmp_path / "a")
    as_is = light_level(clip)
    assert as_is.factor == 1
    assert as_is.ppp == clip.mean_photons
    same = light_level(clip, lux=as_is.lux)
    assert same.factor == pytest.approx(1, rel=1e-12)
    with pytest.raises(ValueError, match="not both"):
        light_level(clip, ppp=1.0, lux=1.0)
    assert "3.25 PPP" in light_line(clip, light_level(clip, ppp=3.25), 0.8)


def test_relative_radiance_needs_a_target(tmp_path: Path):
    clip = write(tmp_path / "r", radiance_unit=RELATIVE, camera=None)
    with pytest.raises(ValueError, match=r"r: its radiance is relative .* --ppp 3.25"):
        light_level(clip)
    level = light_level(clip, ppp=3.25)
    mean = np.mean([clip_photons(clip, t, level.factor).mean() for t in range(FRAMES)])
    assert mean == pytest.approx(3.25, rel=1e-12)


def test_an_interrupted_writer_leaves_nothing_readable_and_goes_on(tmp_path: Path):
    path = tmp_path / "a"
    interrupted(path, 1, 0)
    with pytest.raises(FileNotFoundError, match=r"unfinished \(only a.part is there\)"):
        Clip.open(path)
    # Death in the middle of a journal line and of a temporary file.
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
def test_a_writer_killed_at_every_step_can_begin_again(
    tmp_path: Path, left: dict[str, Any] | None, replaced: bool, force: bool
):
    """Before each file it opens, removes or renames: in an empty folder, going on, clearing, replacing a clip."""
    killed, steps = True, 0
    while killed:
        path = tmp_path / str(steps) / "a"
        path.parent.mkdir()
        if replaced:
            write(path, frame_rate=500.0)
        if left is not None:
            interrupted(path, 0, force=force, **left)
        steps += 1
        killed = killed_at(steps, path, functools.partial(write, path, force=force))
        if not path.exists() or Clip.open(path).frame_rate == 500.0:
            write(path, force=force)
        clip = Clip.open(path)
        assert (clip.frame_rate, clip.verify()) == (2000.0, [])
        assert [item.name for item in path.parent.iterdir()] == ["a"]
        assert sorted(item.name for item in path.iterdir()) == ["clip.json", "radiance", "sharp", "truth"]
    assert steps > 50


@pytest.mark.parametrize("gone", [(), ("begun.json",), ("begun.json", "journal.jsonl"), ("begun.json", "lock")])
def test_a_clip_that_lacks_only_its_name_is_not_made_again(tmp_path: Path, monkeypatch, gone: tuple[str, ...]):
    """Killed after clip.json was written: no frame is lost, and other settings do not get it."""
    part = tmp_path / "a.part"

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda a, b: killed() if Path(a) == part else os.rename(a, b))
        patch.setattr(Path, "unlink", lambda self, **_: os.remove(self) if self.name in gone else None)
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "a")
    frame = part / "radiance" / "000000.exr"
    made, kept = frame.stat().st_ino, frame.read_bytes()
    with pytest.raises(ValueError, match=r"a\.part: 5 frames are there, asked for with other settings"):
        write(tmp_path / "a", shape=[FRAMES - 1, HEIGHT, WIDTH])
    assert interrupted(tmp_path / "a") == list(range(FRAMES))
    clip = write(tmp_path / "a")
    assert clip.verify() == []
    assert (clip.path / "radiance" / "000000.exr").stat().st_ino == made
    assert clip.meta == write(tmp_path / "b" / "a").meta
    clip.path.rename(part)
    frame.write_bytes(kept[:-1])  # and what is damaged is not taken for whole
    assert interrupted(tmp_path / "a") == []


def test_a_damaged_frame_of_an_interrupted_writer_is_done_again(tmp_path: Path):
    interrupted(tmp_path / "a", 0)
    frame = tmp_path / "a.part" / "radiance" / "000000.exr"
    frame.write_bytes(frame.read_bytes()[:-1])
    assert interrupted(tmp_path / "a") == []


def test_other_settings_are_refused_or_start_again(tmp_path: Path):
    interrupted(tmp_path / "a", 0)
    assert interrupted(tmp_path / "a", 1) == [0]
    with pytest.raises(ValueError, match=r"a\.part: 2 frames are there, asked for with other settings"):
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
    with pytest.raises(FileExistsError, match="--force"):
        ClipWriter(tmp_path / "a", meta())
    with ClipWriter(tmp_path / "a", meta(), force=True) as writer:
        for t in range(FRAMES):
            writer.add(t, radiance(t) + 1)
    clip = Clip.open(tmp_path / "a")
    assert clip.mean_radiance > 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


def test_what_is_no_clip_is_never_replaced(tmp_path: Path):
    """Not a folder, not a file, not somebody's folder that has the name of the unfinished one."""
    (tmp_path / "thesis").mkdir()
    for path in (tmp_path / "thesis" / "a.txt", tmp_path / "b", tmp_path / "c.part" / "notes.txt"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("years of work")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for name in ("thesis", "b"):
        with pytest.raises(FileExistsError, match="exists and is no clip"):
            ClipWriter(tmp_path / name, meta(), force=True)
    with pytest.raises(ValueError, match=r"c\.part: holds files of somebody else"):
        ClipWriter(tmp_path / "c", meta()).__enter__()
    left = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.name != "lock"}
    assert left == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": [0, 8, 10]}, "at least one frame"),
        ({"shape": [3, 0, 10]}, "at least one frame"),
        ({"shape": [3, 8]}, "shape must be"),
        ({"exposure": 0}, "exposure must be a number above 0"),
        ({"frame_rate": None}, "frame_rate must be a number above 0"),
        ({"radiance_unit": "nits"}, "radiance_unit must be"),
        ({"camera": None}, "needs a camera"),
    ],
)
def test_impossible_clips_are_refused_before_anything_is_written(tmp_path: Path, changes: dict, message: str):
    with pytest.raises(ValueError, match=message):
        ClipWriter(tmp_path / "a", meta(**changes))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3])
def test_impossible_radiance_is_named_and_leaves_nothing(tmp_path: Path, value: float):
    image = radiance(0).copy()
    image[4, 3] = value
    with pytest.raises(ValueError, match=r"radiance of frame 0 is .* at \(y, x\) = \(4, 3\)"):  # noqa: SIM117
        with ClipWriter(tmp_path / "a", meta()) as writer:
            writer.add(0, image)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_frame_is_not_a_clip(tmp_path: Path):
    writer = ClipWriter(tmp_path / "a", meta()).__enter__()
    for t in (0, 1, 2, 4):
        writer.add(t, radiance(t))
    with pytest.raises(ValueError, match=r"frame 3 was never written \(1 of 5"):
        writer.__exit__(None, None, None)
    with pytest.raises(FileNotFoundError):
        Clip.open(tmp_path / "a")


def test_each_kind_of_damage_is_named(tmp_path: Path):
    clip = write(tmp_path / "a")
    bit_flipped = clip.path / "radiance" / "000001.exr"
    content = bytearray(bit_flipped.read_bytes())
    content[-3] ^= 16
    bit_flipped.write_bytes(content)
    truncated = clip.path / "truth" / "000002.exr"
    truncated.write_bytes(truncated.read_bytes()[:100])
    missing = clip.path / "sharp" / "000002.exr"
    missing.unlink()
    assert [p.split(": ")[0] for p in clip.verify()] == [str(bit_flipped), str(missing), str(truncated)]
    with pytest.raises(ValueError, match="not readable as OpenEXR"):
        clip.flow(2)
    with pytest.raises(FileNotFoundError):
        clip.sharp(2)


def test_a_truncated_radiance_file_is_an_error_not_garbage(tmp_path: Path):
    clip = write(tmp_path / "a")
    path = clip.path / "radiance" / "000001.exr"
    whole = path.read_bytes()
    for content in (b"", whole[:-1], whole + b"\0", b"\0" + whole[1:]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="truncated or damaged"):
            clip.radiance(1)


def test_other_format_versions_are_refused_with_both_numbers(tmp_path: Path):
    clip = write(tmp_path / "a")
    for version, advice in [(2, "newer qsim"), (0, "make it again"), (None, "make it again")]:
        files.write_json(clip.path / "clip.json", clip.meta | {"format_version": version})
        with pytest.raises(ValueError, match=rf"format version {version}, this qsim reads version 1; .*{advice}"):
            Clip.open(clip.path)


def test_a_damaged_manifest_is_named(tmp_path: Path):
    clip = write(tmp_path / "a")
    manifest = clip.path / "clip.json"
    whole = manifest.read_bytes()
    for content in (whole[:50], b"[]", b"\xff\xfe"):
        manifest.write_bytes(content)
        with pytest.raises(ValueError, match=r"clip\.json"):
            Clip.open(clip.path)
    for key in ("shape", "exposure", "checksums"):
        manifest.write_text(json.dumps({k: v for k, v in clip.meta.items() if k != key}))
        with pytest.raises(ValueError, match=f"key '{key}' is missing"):
            Clip.open(clip.path)
    with pytest.raises(FileNotFoundError, match="no such clip"):
        Clip.open(tmp_path / "b")
    with pytest.raises(FileNotFoundError, match="not a clip folder"):
        Clip.open(tmp_path)


def test_the_largest_half_is_kept_and_counted(tmp_path: Path):
    with ClipWriter(tmp_path / "a", meta(shape=[1, 2, 3])) as writer:
        writer.add(0, np.array([[1e6, 65504, 1], [0, 1e-7, 70000]], np.float32))
    clip = Clip.open(tmp_path / "a")
    assert clip.meta["clipped_pixels"] == 2
    assert clip.radiance(0).max() == 65504


@pytest.mark.parametrize(("height", "width"), [(1, 1), (8, 10), (17, 33), (16, 7), (33, 128)])
def test_exr_agrees_with_the_openexr_library(tmp_path: Path, height: int, width: int):
    """Our writer's files, zipped and not, read by the reference library; odd sizes around the 16-row chunks."""
    rng = np.random.default_rng(height)
    smooth = np.cumsum(rng.normal(size=(height, width)), axis=0)
    channels = {
        "u": smooth.astype("<f4"),
        "Z": np.where(smooth > 1, np.inf, smooth).astype("<f4"),
        "id": rng.integers(0, 2**32, (height, width), dtype=np.uint32),
        "h": smooth.astype("<f2"),
    }
    for compress in (False, True):
        path = tmp_path / f"{compress}.exr"
        path.write_bytes(exr.encode(channels, compress=compress))
        found = exr.read(path)
        assert sorted(found) == sorted(channels)
        for name, expected in channels.items():
            np.testing.assert_array_equal(found[name], expected)
