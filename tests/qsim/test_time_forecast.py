"""Tests that a forecast of time is right, and said once, for long work alone."""

import pytest

from qsim.time_forecast import TimeForecast, duration


@pytest.mark.parametrize("parts", [1, 4])
def test_the_time_of_all_steps_and_of_what_precedes_each_part(parts):
    """Two parts of 50 steps of 0.5 s, each after 10 s: said early, once, and within a digit."""
    said = []
    now = [0.0]
    told = TimeForecast("work", said.append, parts=parts, clock=lambda: now[0])
    for part in range(parts):
        now[0] += 10.0
        for step in range(1, 51):
            now[0] += 0.5
            told(50 * part + step, 50 * parts)
            assert bool(said) == ((part, step) >= (0, 3))
    assert said == [f"work takes about {duration(now[0])}, 0.5 s a step"]


def test_short_work_is_not_announced():
    said = []
    now = [0.0]
    told = TimeForecast("work", said.append, clock=lambda: now[0])
    for step in range(10):
        now[0] += 1.5
        told(step + 1, 10)
    assert said == []


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(59.6, "60 s"), (349, "5.8 minutes"), (5000, "83 minutes"), (6000, "1.7 hours"), (1e6, "280 hours")],
)
def test_durations_have_the_unit_in_which_people_count(seconds, text):
    assert duration(seconds) == text
