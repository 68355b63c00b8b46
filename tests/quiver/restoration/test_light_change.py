"""Light that changes is told from noise and from what moves, over random sensors, light levels and motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray as Array

from qsim.keys import Key
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.restoration.domain import light_change

LIGHTS = (
    ("quiver-physical", 1.0, 1),
    ("quiver-physical", 3.25, 3),
    ("quiver-physical", 26.0, 7),
    ("spad-320x240", 1.0, 1),
)


def codes_of(light: Array, sensor: str, ppp: float, bits: int, seed: int) -> Codes:
    device = Illumination.of(sensor, ppp, bits).device(5e-4)
    photons = light * (ppp / light.mean())
    return array_codes(device.sample(photons, 5e-4, key=Key(seed, 3)), device, 5e-4)


def scene(rng: np.random.Generator, side: int, frames: int, speed: float) -> Array:
    """Smooth random light that slides by `speed` px/frame in a random direction, [T, H, W]."""
    waves = rng.normal(size=(6, 2)) * 0.15
    angle = rng.uniform(0, 2 * np.pi)
    phases = rng.uniform(0, 2 * np.pi, 6)
    y, x = np.mgrid[:side, :side]
    out = []
    for t in range(frames):
        u = x + t * speed * np.cos(angle)
        v = y + t * speed * np.sin(angle)
        out.append(1.2 + sum(np.sin(a * u + b * v + c) for (a, b), c in zip(waves, phases, strict=True)) / 6)
    return np.stack(out)


@pytest.mark.parametrize("scenes", [10, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("light", LIGHTS)
def test_motion_and_noise_are_no_change_of_light(light, scenes):
    """Random scenes; remarks begin at 8 %."""
    rng = np.random.default_rng(5)
    found = []
    for seed in range(scenes):
        side = int(rng.integers(48, 112))
        frames = int(rng.integers(2, 14))
        speed = float(rng.choice([0, 0.5, 2, 6, 16]))
        found.append(light_change(codes_of(scene(rng, side, frames, speed), *light, seed)))
    assert max(found) < 0.08
    assert np.mean(found) < 0.005


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("change", [0.4, 0.8])
def test_a_change_is_never_overstated_and_found(light, change):
    """A straight rise over eleven frames, to a twentieth, as squares are uneven. Noise and motion hide part of it."""
    rng = np.random.default_rng(6)
    rise = 1 + change * np.linspace(-0.5, 0.5, 11)[:, None, None]
    for seed in range(10):
        speed = float(rng.choice([0, 0.5, 2]))
        found = light_change(codes_of(scene(rng, 96, 11, speed) * rise, *light, seed))
        assert found < 1.05 * change + 0.02
        assert found > 0.08 or (change < 0.8 and (speed > 0 or light[2] == 1))


def test_a_flicker_of_the_mains_is_found():
    rng = np.random.default_rng(7)
    mains = 1 + 0.3 * np.cos(2 * np.pi * np.arange(22) / 20)[:, None, None]
    assert light_change(codes_of(scene(rng, 96, 22, 1.0) * mains, "quiver-physical", 3.25, 3, 0)) > 0.1


def test_nothing_is_said_where_the_codes_do_not_tell():
    rng = np.random.default_rng(8)
    rise = np.linspace(0.5, 1.5, 11)[:, None, None]
    light = scene(rng, 64, 11, 0.0) * rise
    seen = codes_of(light, "quiver-physical", 3.25, 3, 0)
    assert light_change(seen) > 0.08
    assert light_change(replace(seen, shares=(1.0, 0.25))) == 0
    assert light_change(codes_of(light[:1], "quiver-physical", 3.25, 3, 0)) == 0
    assert light_change(codes_of(light[:, :8, :8], "quiver-physical", 3.25, 3, 0)) == 0
    dark = array_codes(np.zeros((11, 64, 64), np.uint8), seen.sensor, 5e-4)
    full = array_codes(np.full((11, 64, 64), 7, np.uint8), seen.sensor, 5e-4)
    assert light_change(dark) == light_change(full) == 0
