"""Makes text on a moving plate: a printed sign with raised letters slides, swings and turns."""

from __future__ import annotations

import numpy as np

from qsim.scene import (
    Body,
    Diffuse,
    Motion,
    Oscillation,
    Pendulum,
    RoughPlastic,
    Scene,
    Still,
    Texture,
    Translation,
    textures,
)
from qsim.scene.props import letters
from qsim.scene.rotation import pose_matrix, vector
from qsim.scene.shapes import box, moved, sheet
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick

WORDS = (
    "QUANTA",
    "PHOTON",
    "2000 FPS",
    "SENSOR",
    "SHUTTER",
    "MOTION",
    "POISSON",
    "3 BITS",
    "SINGLE",
    "LUMEN",
    "NOISE",
    "KELVIN",
)


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return one plate across the middle, 1 to 3 m/s at speed 1."""
    rng = np.random.default_rng([seed, 7])
    place = Still(
        (0.0, between(rng, -0.015, 0.015), 0.0),
        (float(rng.normal(0, 0.15)), float(rng.normal(0, 0.25)), float(rng.normal(0, 0.08))),
    )
    motion: Motion = carrier(rng, speed) @ place
    width = 0.40
    height = 0.2
    dark = rng.random() < 0.5
    print_ = textures.lines_of_text(random_lines(rng), 1024, 512, *((0.8, 0.04) if dark else (0.06, 0.8)))
    back = moved(box(width, height, 0.006, 0.1), pose_matrix(None, (0, 0, -0.004)))
    bodies = [
        common.wall(Diffuse(common.backdrop(rng)), 1.4, 0.7, z=-0.15),
        Body("plate", back, RoughPlastic(0.4, 0.2), motion),
        Body("print", sheet(width, height), RoughPlastic(Texture(print_), 0.3), motion),
    ]
    word = letters(pick(rng, WORDS), 0.05, 0.012)
    word = moved(word, pose_matrix(np.eye(3) * min(1.0, 0.34 / float(np.ptp(word.vertices[:, 0]))), (0, 0.055, 0.006)))
    bodies.append(Body("letters", word, RoughPlastic(0.75 if dark else 0.05, 0.2), motion))
    view = common.camera((between(rng, -0.12, 0.12), between(rng, -0.06, 0.1), 0.6), (0, 0, 0), 0.45)
    return Scene("text", seed, view, (common.studio(rng), common.lamp(rng, (0, 0, 0), 0.9, 1.5)), tuple(bodies), speed)


def carrier(rng: np.random.Generator, speed: float) -> Motion:
    """Return the motion of the plate: a slide, a swing or a shake."""
    kind = int(rng.integers(3))
    if kind == 0:
        angle = any_angle(rng)
        rate = between(rng, 1.2, 2.5) * speed
        velocity = np.array([rate * np.cos(angle), 0.6 * rate * np.sin(angle), 0.3 * rng.normal() * speed])
        return Translation(vector(velocity), vector(-velocity * common.CLIP / 2))
    if kind == 1:
        return Pendulum((0.0, 0.35, 0.0), (0, 0, 1), 0.25, speed * between(rng, 3, 5), any_angle(rng))
    amplitude = (between(rng, 0.02, 0.05), between(rng, 0.005, 0.02), 0.0)
    return Oscillation(amplitude, speed * between(rng, 8, 14), any_angle(rng))


def random_lines(rng: np.random.Generator) -> list[str]:
    """Return the lines of an eye chart: a free heading, then letters of decreasing size."""
    alphabet = list("ABCDEFGHJKLMNPQRSTUVWXYZ23456789")
    return ["", *("".join(rng.choice(alphabet, n)) for n in (11, 16, 24))]
