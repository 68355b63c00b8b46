"""Event cameras by name and in files: strict reading, and messages that name what is wrong."""

from __future__ import annotations

import pytest

from qsim.sensor import event_camera as cameras
from qsim.sensor.event_camera import EventCamera


def test_every_named_camera_states_the_source_of_what_it_sets():
    for named in cameras.CAMERAS.values():
        own = {name for name, value in vars(named.camera).items() if value != getattr(EventCamera(), name)}
        assert own <= set(named.sources)


def test_a_file_holds_the_fields_of_a_camera(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        '[sensor]\nmodel = "EventCamera"\nthreshold_on = 0.3\ncutoff = 90\n[sources]\ncutoff = "measured"\n'
    )
    made = cameras.load(file)
    assert made == EventCamera(threshold_on=0.3, cutoff=90.0)
    assert cameras.from_dict(made.to_dict()) == made
    assert cameras.load(made) is made


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[sensor]\nmodel = "QIS"\n', "an event camera has model = \"EventCamera\", got 'QIS'"),
        ('[sensor]\nmodel = "EventCamera"\nthreshold = 0.3\n', "threshold"),
        ('[sensor]\nmodel = "EventCamera"\nthreshold_on = 0.001\n', "threshold_on"),
        ('[sensor]\nmodel = "EventCamera"\ndark_current = 0\n', "dark_current"),
        ('[sensor]\nmodel = "EventCamera"\n[sources]\nbits = "x"\n', r"unknown key 'bits' in \[sources\]"),
        ('[sensor]\nmodel = "EventCamera"\n[defects]\nprnu = 0.1\n', r"unknown table \[defects\]"),
        ("", r"a table \[sensor\] with model"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text: str, message: str):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"mine.toml.*{message}"):
        cameras.load(file)


def test_an_unknown_name_gets_the_one_that_was_meant():
    with pytest.raises(ValueError, match=r"unknown event camera 'dvs-idea' .did you mean 'dvs-ideal'\?"):
        cameras.load("dvs-idea")
