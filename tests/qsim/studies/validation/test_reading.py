"""Random crops for training: both readers read the same windows, and the verdict follows from their speeds."""

import json

import numpy as np
import pytest

from qsim.cli.program import main
from qsim.studies.validation import reading
from qsim.studies.validation.reading import ReadingReport


def test_what_counts_as_quick():
    for clip, mp4, difference, ok in [
        (100.0, 20.0, 0.01, True),
        (99.0, 2.0, 0.01, False),
        (200.0, 41.0, 0.01, False),
        (200.0, 20.0, 0.3, False),
    ]:
        assert ReadingReport(clip, mp4, clip, mp4 / 2, difference).ok == ok


@pytest.mark.slow
def test_both_sides_read_equal_windows(capsys: pytest.CaptureFixture[str]):
    """Ours and FFmpeg on the same windows: the pictures agree; the exit code is the verdict on speed, which is free."""
    pytest.importorskip("av")
    code = main(["validate", "reading", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["difference"] < 0.05, "the two sides read different windows"
    assert found["clip"] > 0
    assert found["mp4"] > 0
    assert code == (0 if found["ok"] else 1)


@pytest.mark.slow
def test_the_two_sides_read_the_same_window(monkeypatch: pytest.MonkeyPatch):
    """A window one frame off is seen: the texture moves by 3 pixels per frame."""
    pytest.importorskip("av")
    right = reading.from_mp4
    monkeypatch.setattr(reading, "from_mp4", lambda path, at: right(path, ((at[0] + 1) % 50, *at[1:])))
    report = reading.run(seconds=0.1)
    assert report.difference > 0.2
    assert np.isfinite(report.ratio)
