"""Tests the learning rate, the plateau and the time limit."""

from __future__ import annotations

import pytest

from quiver.training.schedule import State, learning_rate, note_plateau, time_is_up
from quiver.training.settings import Settings


def test_cosine_follows_steps_or_time():
    by_steps = Settings("d", "o", steps=1000, learning_rate=1.0, warmup=10)
    assert learning_rate(by_steps, State(step=0)) == pytest.approx(0.1)
    short = Settings("d", "o", steps=100, learning_rate=1.0, warmup=1000, schedule="plateau")
    assert learning_rate(short, State(step=2)) == pytest.approx(0.4)  # the rise ends after a twentieth: at step 5
    assert learning_rate(short, State(step=5)) == 1.0
    assert learning_rate(by_steps, State(step=500)) == pytest.approx(0.5)
    assert learning_rate(by_steps, State(step=1000)) == pytest.approx(0.01)  # never zero
    by_time = Settings("d", "o", minutes=10, learning_rate=1.0, warmup=0)
    assert learning_rate(by_time, State(step=77, elapsed=300)) == pytest.approx(0.5)


def test_plateau_halves_at_the_ninth_validation_without_gain():
    """With patience 8, the ninth validation in a row without a relative gain of 1e-4 halves the rate."""
    state = State()
    plan = Settings("d", "o", steps=9, schedule="plateau", warmup=0, learning_rate=1.0)
    note_plateau(8, state, 30.0)
    for _ in range(8):
        note_plateau(8, state, 30.002)
    assert state.halvings == 0
    note_plateau(8, state, 30.002)
    assert state.halvings == 1
    assert learning_rate(plan, state) == 0.5
    note_plateau(8, state, 30.004)
    assert state.plateau_bad == 0


def test_the_last_validation_fits_into_the_limit():
    plan = Settings("d", "o", minutes=1)
    assert not time_is_up(plan, State(elapsed=50.0), 5.0)
    assert time_is_up(plan, State(elapsed=50.0), 11.0)
    assert not time_is_up(Settings("d", "o", steps=1), State(elapsed=1e9), 1.0)
