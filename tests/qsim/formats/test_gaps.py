"""Tests that lost frames and uneven steps are told with their place, and that lost frames can be kept as missing."""

import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import CAPTURE

from qsim.formats import gaps, images, importing
from qsim.formats.recording import Hints, Times


def folder_of(path: Path, numbers: list[int], bits: int = 8) -> Path:
    """PNGs whose grey is their place."""
    path.mkdir()
    images.write_png(path, iter([np.full((4, 6), 10 + i, np.uint8) for i in range(len(numbers))]))
    for i, number in reversed(list(enumerate(numbers))):
        (path / f"{i:06d}.png").rename(path / f"frame_{number}.png")
    return path


@settings(max_examples=100, deadline=None)
@given(
    lost=st.dictionaries(st.integers(0, 18), st.integers(1, 30), max_size=6),
    step=st.sampled_from([1 / 30, 1 / 240, 64 / 15360, 1.0, 5.0]),
    digits=st.integers(3, 7),
    start=st.floats(0, 1e6),
)
def test_gaps_are_found_where_they_are(lost: dict[int, int], step: float, digits: int, start: float):
    """Times are rounded to a tick of at most a fifth of a step."""
    tick = 10.0**-digits
    steps = [step * (1 + lost.get(t, 0)) for t in range(19)]
    times = np.round(start + np.concatenate([[0], np.cumsum(steps)]), digits)
    if tick > step / 5:
        return
    assert gaps.find(Times(tuple(times), "s", "test", tick)).lost == lost


def test_even_times_of_any_rounding_have_no_gaps():
    for rate, tick in ((2000, 1e-3), (30, 1e-3), (24000 / 1001, 1e-2), (7, 0.1)):
        times = np.round(np.arange(50) / rate / tick) * tick
        assert gaps.find(Times(tuple(times), "s", "test", tick)) == gaps.Gaps({})


def test_a_variable_rate_is_told_with_its_place():
    times = np.cumsum([0, 1, 1, 1.4, 1, 1, 0.7, 1])
    assert gaps.find(Times(tuple(times), "s", "test", 1e-3)).uneven == (pytest.approx(0.7), pytest.approx(1.4), 2)


def test_lost_pictures_are_told_and_kept_as_missing(tmp_path: Path):
    path = folder_of(tmp_path / "in", [1, 2, 3, 7, 8])
    hints = {"transfer": "linear"}
    with pytest.warns(UserWarning, match=r"numbers in the names of the files: 3 frames are lost: 3 between 3 and 7"):
        recording = importing.read(path, Hints(**hints))
    assert recording.shape == (5, 4, 6)
    clip = importing.to_clip(recording, tmp_path / "closed", CAPTURE)
    assert clip.info.times.values == (1, 2, 3, 7, 8)
    kept = importing.to_clip(importing.read(path, Hints(**hints, keep_gaps=True)), tmp_path / "kept", CAPTURE)
    assert kept.info.source.missing_frames == (3, 4, 5)
    assert kept.info.times.values == tuple(range(1, 9))
    for t in range(8):
        missing = t in (3, 4, 5)
        assert kept.saturated(t).all() == missing
        assert kept.saturated(t).any() == missing
        found = t if t < 3 else t - 3  # the file of this instant
        grey = 0 if missing else 10 + found
        np.testing.assert_allclose(kept.radiance(t), grey / 255, rtol=1e-3)
    assert "no pixel reaches it" in importing.saturation_line(kept)
    with pytest.raises(ValueError, match="streams of codes hold no missing frames"):
        importing.read(path, Hints(bits=8, keep_gaps=True))
    even = folder_of(tmp_path / "even", [2, 4, 6, 8])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert importing.read(even, Hints(**hints)).shape == (4, 4, 6)
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4), np.float32))
    with pytest.raises(ValueError, match=r"keep_gaps= changes nothing for \.npy"):
        importing.read(tmp_path / "a.npy", Hints(keep_gaps=True))


def test_lost_frames_of_videos_are_told(tmp_path: Path):
    av = pytest.importorskip("av")
    for name in ("a.mp4", "a.mkv"):
        with av.open(tmp_path / name, "w") as container:
            stream = container.add_stream("libx264", rate=100)
            stream.height = 32
            stream.width = 48
            stream.pix_fmt = "yuv420p"
            stream.codec_context.time_base = Fraction(1, 100)
            for t in (0, 1, 2, 3, 7, 8, 9, 10):
                frame = av.VideoFrame.from_ndarray(np.full((32, 48, 3), 20 * t, np.uint8), format="rgb24")
                frame.pts = t
                frame.time_base = Fraction(1, 100)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        with pytest.warns(UserWarning, match=r"presentation times of the video: 3 frames are lost: 3 between 0.03 and"):
            assert importing.read(tmp_path / name, Hints(transfer="linear")).shape == (8, 32, 48)


def test_missing_files_of_raw_frames_are_told(tmp_path: Path):
    for n in (0, 1, 3):
        (tmp_path / f"filename{n}.bin").write_bytes(bytes(16384))
    with pytest.warns(UserWarning, match=r"no file is between filename1.bin and filename3.bin \(1 of 4 are missing\)"):
        importing.read(tmp_path, Hints("swissspad2-half"))
