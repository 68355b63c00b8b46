"""Compiled draws of any number of pixels."""

import pytest

import qsim.sensor.sensor


@pytest.fixture(autouse=True)
def compile_everything(monkeypatch):
    """Small draws are compiled too, which programs leave to the reference."""
    monkeypatch.setattr(qsim.sensor.sensor, "SMALLEST", 1)
