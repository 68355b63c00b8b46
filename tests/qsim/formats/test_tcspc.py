"""Tests photon counts of PTU and SDT files: written by ptufile, and by hand after the documented headers of SDT."""

from pathlib import Path

import numpy as np
import pytest
from recordings import everything
from sdt_files import sdt_bytes

from qsim.formats import importing
from qsim.formats.recording import Hints

FRAMES = np.random.default_rng(0).poisson(1.5, (3, 5, 6, 2, 8)).astype(np.uint16)  # [T, Y, X, C, H]


def test_ptu_images(tmp_path: Path):
    ptufile = pytest.importorskip("ptufile")
    path = tmp_path / "a.ptu"
    ptufile.imwrite(path, FRAMES, 1e-7, 1e-8, pixel_time=1e-5)
    counts = FRAMES.sum(axis=-1)
    with pytest.raises(ValueError, match="choose with channel=0"):
        importing.read(path)
    for channel in (0, 1):
        np.testing.assert_array_equal(everything(path, channel=channel), counts[..., channel])
    recording = importing.read(path, Hints(channel=1))
    assert "T=3, Y=5, X=6 of axes TYXC; channel 1 of 2; photons summed over the laser period" in recording.reading
    assert recording.bits == int(counts[..., 1].max()).bit_length()
    assert recording.exposure == pytest.approx(1e-5)
    stream = importing.to_stream(recording, tmp_path / "s", importing.Import(recording.frame_rate or 1.0))
    assert stream.info.code_model == "counting"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="not readable as PTU"):
        importing.read(path, Hints(channel=0))


def test_sdt_images(tmp_path: Path):
    pytest.importorskip("sdtfile")
    images = FRAMES[:, :, :, 0]
    path = tmp_path / "a.sdt"
    path.write_bytes(sdt_bytes(images))
    counts = images.sum(axis=-1)
    np.testing.assert_array_equal(everything(path, channel=2), counts[2:])
    np.testing.assert_array_equal(everything(path, axes="TYX"), counts)
    with pytest.raises(
        ValueError, match=r"axes C=3, Y=5, X=6: .*choose with channel=0 \(to 2\), or name the axis of the frames T"
    ):
        importing.read(path)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(ValueError, match="not readable as SDT"):
        importing.read(path)
