"""Records of plain values: every refusal names place, expectation and value; what is accepted has the type's form."""

from __future__ import annotations

import dataclasses
import gc
import sys
from dataclasses import dataclass, field
from typing import Annotated

import hypothesis
import msgspec
import numpy as np
import pytest
from hypothesis import given as over
from hypothesis import strategies as st

from qsim import records, settings
from qsim.kinds import Bits, Count, Light, Positive, RowOrder, Schedule
from qsim.rendering.render_settings import RenderSettings
from qsim.settings import setting


class Device:
    """A class that no file holds."""


@dataclass(frozen=True)
class Delay:
    delay: Positive
    order: RowOrder = "down"

    def __post_init__(self) -> None:
        if self.delay > 5:
            raise ValueError("delay is too long")


@dataclass(frozen=True)
class Table:
    ppp: Light | None = None
    bits: Bits = 3
    rows: Delay | None = None
    shares: Schedule | None = None
    named: dict[str, Delay] = field(default_factory=dict)
    several: tuple[Delay, ...] = ()
    place: tuple[Count, Count] = (0, 0)


@dataclass(frozen=True)
class Choices:
    sensor: Annotated[str | Device, setting("name or record")]
    bits: Annotated[Bits | None, setting("bits per code", unset="the sensor's own", short="b")] = None
    light_level: Annotated[Light, setting("mean photons", unit="photons/px")] = 3.25
    shares: Annotated[Schedule | None, setting("shares of a code's time")] = None
    group: Annotated[bool, setting("sum planes")] = False
    made: Annotated[int, msgspec.Meta(description="for the schema")] = 0  # no setting

    def __post_init__(self) -> None:
        records.settle(self)


REFUSED = {
    "bits: expected a whole number from 1 to 16, got 17": {"bits": 17},
    "bits: expected a whole number from 1 to 16, got 1.5": {"bits": 1.5},
    "bits: expected a whole number from 1 to 16, got True": {"bits": True},
    "bits: expected a whole number from 1 to 16, got a number of more than 30 digits": {"bits": 10**40},
    "ppp: expected a number from 1e-06 to 1e+06, got nan": {"ppp": float("nan")},
    "unknown key 'bitz' (did you mean 'bits'?)": {"bitz": 1},
    "rows: expected a table of values, got 3": {"rows": 3},
    "rows.order: expected one of down, up, right, left, got 'upp'": {"rows": {"delay": 1, "order": "upp"}},
    "unknown key 'rows.ordr' (did you mean 'order'?)": {"rows": {"delay": 1, "ordr": "up"}},
    "rows: delay is too long": {"rows": {"delay": 9}},
    "key 'rows.delay' is missing": {"rows": {}},
    "shares[1]: expected a number from 1e-06 to 1, got 2": {"shares": [1, 2]},
    "shares: expected a list of 1 to 256: a number from 1e-06 to 1, got []": {"shares": []},
    "several[1].delay: expected a number above 0, got -1": {"several": [{"delay": 1}, {"delay": -1}]},
    "unknown key 'several[0].dela' (did you mean 'delay'?)": {"several": [{"dela": 1}]},
    "named.b.delay: expected a number above 0, got -1": {"named": {"a": {"delay": 1}, "b": {"delay": -1}}},
    "unknown key 'named.a.dela' (did you mean 'delay'?)": {"named": {"a": {"dela": 1}}},
    "place: expected a list of 2: a whole number from 0, got [1]": {"place": [1]},
    "expected a table of values, got [1]": [1],
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_refusal_names_place_expectation_and_value(message):
    with pytest.raises(ValueError) as caught:
        records.convert(REFUSED[message], Table, "f.toml", cure="mend it")
    assert str(caught.value).startswith(f"f.toml: {message}")
    assert str(caught.value).endswith("; mend it")


def test_deep_nesting_is_refused_in_one_sentence():
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(ValueError, match=r"expected a table of values|nested too deeply"):
        records.convert({"rows": deep}, Table, "f.json")


plain_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", "b", "delay"]), inner),
    max_leaves=6,
)


@hypothesis.settings(deadline=None)
@over(st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(Table)]), plain_values, max_size=4))
def test_any_table_becomes_a_record_or_one_sentence(found):
    refusal = ""
    made = None
    try:
        made = records.convert(found, Table, "f.json")
    except ValueError as error:
        refusal = str(error)
    if made is None:
        assert refusal.startswith("f.json: ")
        assert len(refusal.splitlines()) == 1
    else:
        assert records.convert(records.plain(made), Table, "f.json") == made
        assert msgspec.json.decode(msgspec.json.encode(made), type=Table) == made


def test_given_values_take_the_form_of_their_types():
    made = Choices("a", np.int64(3), light_level=1, shares=[1, np.float32(0.5)], group=np.True_)
    assert made == Choices("a", 3, 1.0, (1.0, 0.5), True)
    assert [type(value) for value in (made.bits, made.light_level, made.shares, made.group)] == [
        int,
        float,
        tuple,
        bool,
    ]
    assert isinstance(Choices(Device()).sensor, Device)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sensor": 3}, "sensor: expected a text or a Device, got 3"),
        ({"bits": 17}, "bits: expected a whole number from 1 to 16, got 17"),
        ({"light_level": None}, "light_level: expected a number from 1e-06 to 1e\\+06, got None"),
        ({"group": 1}, "group: expected true or false, got 1"),
    ],
)
def test_a_wrong_argument_is_refused_as_a_wrong_key_is(wrong, message):
    with pytest.raises(ValueError, match=message):
        Choices(**{"sensor": "a"} | wrong)


def test_settings_are_the_declared_fields():
    found = {each.name: each for each in settings.settings_of(Choices)}
    assert list(found) == ["sensor", "bits", "light_level", "shares", "group"]
    assert found["sensor"].required
    assert found["bits"].help_with_default == "bits per code (default: the sensor's own)"
    assert found["light_level"].help_with_default == "mean photons [photons/px] (default 3.25)"
    assert found["light_level"].option == "light-level"
    assert found["group"].help_with_default == "sum planes"
    assert found["bits"].short == "b"


def test_a_setting_that_is_off_is_not_stored():
    assert settings.given(Choices("a")) == {"sensor": "a"}
    assert settings.given(Choices("a", bits=2, shares=(1.0, 0.5))) == {"sensor": "a", "bits": 2, "shares": [1.0, 0.5]}


def test_layouts_of_types_outlive_the_collector():
    """Each is held by one more reference than Python knows of: the collector cannot clear it at the end."""
    records.convert({"frames": 3}, RenderSettings, "here")
    layouts = [each for each in gc.get_objects() if type(each).__name__ == "DataclassInfo"]
    before = [sys.getrefcount(each) for each in layouts]
    assert records.keep_layouts() >= len(layouts) > 0
    assert [sys.getrefcount(each) for each in layouts] == [count + 1 for count in before]
