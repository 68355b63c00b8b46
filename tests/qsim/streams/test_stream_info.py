"""The description of a stream: every setting is stored, compared and read again without being named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from qsim import descriptions, files, records
from qsim.sensor.devices import DEVICES, load
from qsim.sensor.qis import QIS
from qsim.settings import settings_of
from qsim.streams.drawing import DRAWERS
from qsim.streams.sensing import Sensing
from qsim.streams.stream_info import StreamInfo, stored_settings

SENSOR = QIS(0.8, 1.6, 0.2, 3)
PLAIN = StreamInfo.of(SENSOR, shape=(4, 5, 6), exposure=5e-4, frame_rate=2000.0)
OTHER = {  # of every setting whose outcome is not in the description: a value that is no default
    "ppp": 3.25,
    "lux": 2.0,
    "seed": 7,
    "group": True,
    "diffraction": True,
    "slices": 3,
    "row_delay": 1e-6,
    "row_order": "up",
    "exposures": (1.0, 0.25),
    "light_drift": 0.2,
    "follow": True,
    "temperature": 25.0,
    "pixel_pitch": 1.1e-6,
}


def test_every_setting_is_stored_compared_and_read_again(tmp_path):
    elsewhere = {"sensor", "bits", "planes", "name", "defects", "colour"}
    assert set(OTHER) == {setting.name for setting in settings_of(Sensing)} - elsewhere
    for name, value in OTHER.items():
        more = {"row_delay": 1e-6} if name == "row_order" else {}
        asked = Sensing("quiver-physical", 3, **more | {name: value})
        info = replace(PLAIN, sensor_name="quiver-physical", settings=stored_settings(asked))
        path = tmp_path / f"{name}.json"
        descriptions.write(path, info)
        found = descriptions.read(path, StreamInfo, "mend it")
        assert found == info
        assert replace(found.sensing, bits=3) == asked
        assert found.compared != replace(info, settings=more).compared


def test_a_setting_that_is_off_is_not_in_the_file():
    off = Sensing("quiver-physical", seed=0, group=False, slices=1)
    assert stored_settings(off) == {}
    assert "settings" not in records.plain(replace(PLAIN, settings=stored_settings(off)))


def test_folders_of_files_do_not_make_another_stream():
    maps = {"dark_map": {"file": "/a/dark.npy", "sha256": "0" * 64}}
    moved = {"dark_map": {"file": "/b/dark.npy", "sha256": "0" * 64}}
    one = replace(PLAIN, sensor_name="/a/my.toml", defects=maps)
    assert one.compared == replace(one, sensor_name="/b/my.toml", defects=moved).compared
    assert one.compared != replace(one, sensor_name="/a/other.toml").compared


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"settings": {"sliced": 2}}, r"unknown key 'sliced' \(did you mean 'slices'\?\)"),
        ({"settings": {"slices": 0}}, "slices: expected a whole number from 1 to 100000, got 0"),
        ({"bits": 4}, "bits: 4 contradict those of the sensor, 3"),
        ({"shape": [4, 5]}, "shape: expected a list of 3"),
        ({"lihgt": None}, r"unknown key 'lihgt' \(did you mean 'light'\?\)"),
    ],
)
def test_descriptions_that_cannot_be_are_refused(tmp_path, changes, message):
    values = records.plain(PLAIN) | {"format_version": 1} | changes
    files.write_json(tmp_path / "s.json", descriptions.sealed(values))
    with pytest.raises(ValueError, match=rf"s\.json: .*{message}.*; mend it"):
        descriptions.read(tmp_path / "s.json", StreamInfo, "mend it")


def test_every_law_that_a_sensor_states_has_a_drawer():
    laws = {"events"}
    for name in DEVICES:
        for bits in (None, 12):
            try:
                sensor = load(name, ppp=3.25, bits=bits)
            except ValueError:  # of one depth
                continue
            for flags in np.ndindex(2, 2, 2):
                laws.add(sensor.law(**dict(zip(("summed", "disturbed", "read_out"), map(bool, flags), strict=True))))
    assert laws <= set(DRAWERS)
    assert {"table", "process", "planes", "closed form"} <= laws
