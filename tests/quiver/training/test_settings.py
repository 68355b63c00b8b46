"""Tests the settings of a run: protocols, mixed light, and wrong values."""

from __future__ import annotations

import math

import pytest
from runs import settings

from qsim import records
from quiver.training.settings import PROTOCOLS, Protocol, Settings, portable


def test_protocols_are_those_of_the_paper_and_its_program():
    published = Settings("d", "o", **PROTOCOLS["published"])
    assert (published.learning_rate, published.batch, published.crop, published.patience) == (1e-4, 8, 128, 8)
    assert (published.schedule, published.validate_every, published.clip_norm) == ("plateau", 300, 20)
    assert published.force_exposure
    assert not published.reverse
    paper = Settings("d", "o", **PROTOCOLS["paper"])
    assert (paper.learning_rate, paper.batch, paper.loss, paper.sensor) == (2.5e-5, 4, "paper", "quiver-paper")
    assert Settings("d", "o", steps=1, **PROTOCOLS["spad-sum"]).lights[0].device(7e-4).white(7e-4) == 7


def test_a_protocol_decides_settings_that_exist_as_the_settings_take_them():
    for found in PROTOCOLS.values():
        assert records.convert(records.plain(dict(found)), Protocol, "protocol")
        Settings("d", "o", **{"steps": 1} | found)
    assert set(Protocol.__annotations__) <= set(records.hints_of(Settings))
    with pytest.raises(ValueError, match="batch"):
        records.convert({"batch": "eight"}, Protocol, "protocol")


def test_every_level_and_depth_is_mixed():
    lights = Settings("d", "o", steps=1, ppp=(3.25, 26.0), bits=(1, 3)).lights
    assert {(light.ppp, light.bits) for light in lights} == {(3.25, 1), (3.25, 3), (26.0, 1), (26.0, 3)}


@pytest.mark.parametrize(
    ("sensor", "found"),
    [("/home/me/my.toml", "my.toml"), (("a/my.toml", "spad512s"), ["my.toml", "spad512s"]), (None, None)],
)
def test_weights_state_a_sensor_without_its_folder(tmp_path, sensor, found):
    """Also those of a run on a stream, whose settings have no noise."""
    assert portable(settings(tmp_path, tmp_path, sensor=sensor))["sensor"] == found


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": None}, "give a training length, as steps= or as minutes="),
        ({"steps": 0}, "steps: expected a whole number from 1, got 0"),
        ({"learning_rate": math.nan}, "learning_rate: expected a number above 0, got nan"),
        ({"loss": "l3"}, "no loss is called 'l3'; known are published, paper, l1"),
    ],
)
def test_bad_settings_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        settings(tmp_path, tmp_path, **changes)
