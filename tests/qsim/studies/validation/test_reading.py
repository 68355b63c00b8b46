"""Tests the comparison of readers: both read the same windows, and the verdict follows from their speeds."""

import json

import numpy as np
import pytest

from qsim.cli.program import main
from qsim.studies.validation import reading
from qsim.studies.validation.reading import ReadingReport


def test_the_verdict_follows_from_speed_ratio_and_difference():
    for clip, mp4, difference, ok in [
        (100.0, 20.0, 0.01, True),
        (99.0, 2.0, 0.01, False),
        (200.0, 41.0, 0.01, False),
        (200.0, 20.0, 0.3, False),
    ]:
        assert ReadingReport(clip, mp4, clip, mp4 / 2, difference).ok == ok


@pytest.mark.slow
def test_both_sides_read_equal_windows(capsys: pytest.CaptureFixture[str]):
    """The pictures of both readers agree; the exit code is the verdict, and no speed is required here."""
    pytest.importorskip("av")
    code = main(["validate", "reading", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["difference"] < 0.05, "the two sides read different windows"
    assert found["clip"] > 0
    assert found["mp4"] > 0
    assert code == (0 if found["ok"] else 1)


@pytest.mark.slow
def test_windows_one_frame_apart_differ(monkeypatch: pytest.MonkeyPatch):
    """The texture moves by 3 px per frame, so a window one frame off differs."""
    pytest.importorskip("av")
    right = reading.from_mp4
    monkeypatch.setattr(reading, "from_mp4", lambda path, at: right(path, ((at[0] + 1) % 50, *at[1:])))
    report = reading.run(seconds=0.1)
    assert report.difference > 0.2
    assert np.isfinite(report.ratio)
