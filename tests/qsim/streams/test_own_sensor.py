"""A sensor of one's own class is refused before its stream is written, which nothing could open."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from clips import write_clip

import qsim
from qsim.formats import read
from qsim.sensor.qis import QIS


@dataclass(frozen=True)
class Own(QIS):
    """A user's model."""


def test_own_sensors_leave_no_stream(tmp_path: Path):
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    with pytest.raises(ValueError, match="Own: is none of the models that a file can name"):
        clip.sense(Own(0.8, 1.6, 0.2, 3), ppp=3.0)
    with pytest.raises(ValueError, match="sensor: expected a text or a Sensor, got 3"):
        clip.sense(3, ppp=3.0)
    assert clip.streams == ()


@pytest.mark.parametrize("given", ["folder", Path("folder")])
def test_a_name_alone_is_no_clip(given: str | Path):
    with pytest.raises(ValueError, match=r"a clip folder is opened by Clip\.open\('folder'\)"):
        qsim.Clip(given)


def test_reading_takes_a_name(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="none: no such file"):
        read(str(tmp_path / "none"))
    for reads in (read, qsim.Clip.open, qsim.Stream.open, qsim.Dataset.open, qsim.load_sensor, qsim.read_mitsuba):
        with pytest.raises(ValueError, match="path is the name of a file or folder, got 3"):
            reads(3)
