"""Makes light that flickers: a still life under lamps on the mains, a switched LED, and a little daylight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from qsim.scene import AreaLamp, Constant, Flicker, Mains, PulseWidth, RectifiedSine, Scene
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick
from qsim.scenes.lamp import still_life

LED_RATES = (200.0, 400.0, 1000.0)  # Hz


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return a table under a tube and an LED, whose flicker does not depend on `speed`, and steady daylight."""
    rng = np.random.default_rng([seed, 17])
    bodies, view = still_life(rng, speed)
    daylight = Constant(between(rng, 0.03, 0.1))
    tube = replace(common.lamp(rng, (0, 0, 0), 1.2, 2.0), flicker=on_mains(rng))
    led = replace(spot(rng), flicker=PulseWidth(pick(rng, LED_RATES), between(rng, 0.2, 0.8), any_angle(rng)))
    return Scene("mains", seed, view, (daylight, tube, led), tuple(bodies), speed)


def on_mains(rng: np.random.Generator) -> Flicker:
    """Return the flicker of a lamp at 50 or 60 Hz, smoothed or not."""
    frequency = 2 * pick(rng, (50.0, 60.0))
    phase = any_angle(rng)
    depth = between(rng, 0.2, 0.8)
    return Mains(frequency, depth, phase) if rng.random() < 0.5 else RectifiedSine(frequency, phase)


def spot(rng: np.random.Generator) -> AreaLamp:
    """Return a small lamp above the table."""
    place = (between(rng, -0.3, 0.3), between(rng, 0.5, 0.7), between(rng, 0.1, 0.4))
    return AreaLamp(place, (0.0, -0.05, 0.0), 0.1, 0.1, between(rng, 20, 40))
