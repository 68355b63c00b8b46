"""Tests reading of clip folders: contents, crops, and messages about damage."""

from pathlib import Path

import numpy as np
import pytest
from tiny_clip import FRAMES, HEIGHT, WIDTH, radiance, truth, write


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
    with pytest.raises(ValueError, match=r"frame 5 does not exist; the clip has frames 0\.\.4"):
        clip.radiance(5)


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


def test_a_truncated_radiance_file_is_refused(tmp_path: Path):
    clip = write(tmp_path / "a")
    path = clip.path / "radiance" / "000001.exr"
    whole = path.read_bytes()
    for content in (b"", whole[:-1], whole + b"\0", b"\0" + whole[1:]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="truncated or damaged"):
            clip.radiance(1)
