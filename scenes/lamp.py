"""Makes low light: a still life in a dark room under one swinging lamp, with moving shadows and glints."""

from __future__ import annotations

import numpy as np

from qsim.scene import (
    AreaLamp,
    Body,
    Camera,
    Conductor,
    Constant,
    Diffuse,
    Material,
    Motion,
    Pendulum,
    RoughPlastic,
    Scene,
    Spin,
    Still,
    Translation,
)
from qsim.scene.rotation import vector
from qsim.scenes import common, tumble
from qsim.scenes.common import any_angle, between, sign

TABLE = -0.09  # m


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return bodies on a table, half of them turning, and two that pass at 2 to 4 m/s at speed 1."""
    rng = np.random.default_rng([seed, 12])
    bodies, view = still_life(rng, speed)
    lights = (Constant(between(rng, 0.001, 0.003)), swinging(rng, speed))
    return Scene("lamp", seed, view, lights, tuple(bodies), speed)


def still_life(rng: np.random.Generator, speed: float) -> tuple[list[Body], Camera]:
    """Return bodies on a table before a wall, two that pass above it, and a camera that looks at them."""
    bodies = [
        common.floor(Diffuse(common.backdrop(rng, 0.1, 0.7)), 1.8, y=TABLE, z=-0.3),
        common.wall(Diffuse(common.backdrop(rng, 0.1, 0.7)), 2.0, 1.0, z=-0.45),
    ]
    count = int(rng.integers(5, 8))
    xs = rng.permutation(np.linspace(-0.24, 0.24, count)) + rng.normal(0, 0.015, count)
    for i, x in enumerate(xs):
        solid = tumble.shape(rng)
        place = Still((float(x), TABLE - float(solid.vertices[:, 1].min()), between(rng, -0.2, 0.1)))
        turn: Motion = Spin((0, 1, 0), speed * between(rng, 40, 80) * sign(rng), any_angle(rng))
        bodies.append(Body(f"thing {i}", solid, finish(rng), place @ turn if i % 2 else place))
    for i in range(2):
        velocity = speed * np.array([sign(rng) * rng.uniform(2.0, 4.0), rng.normal(0, 0.5), 0.0])
        middle = np.array([rng.uniform(-0.12, 0.12), rng.uniform(0.02, 0.09), rng.uniform(-0.1, 0.1)])
        flight = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
        turn = Spin(common.direction(rng), speed * between(rng, 15, 40), any_angle(rng))
        bodies.append(Body(f"flyer {i}", tumble.shape(rng), finish(rng), flight @ turn))
    view = common.camera((between(rng, -0.15, 0.15), between(rng, 0.08, 0.2), 0.65), (0, -0.02, 0), 0.5)
    return bodies, view


def swinging(rng: np.random.Generator, speed: float) -> AreaLamp:
    """Return a lamp on a pendulum above the table, with about a fiftieth of the light of other families."""
    place = (between(rng, -0.15, 0.15), between(rng, 0.3, 0.4), between(rng, 0.0, 0.2))
    pivot = (place[0], place[1] + 0.5, place[2])
    axis = vector((rng.normal(0, 0.3), 0.0, 1.0))
    swing = Pendulum(pivot, axis, between(rng, 0.15, 0.3), speed * between(rng, 2, 5), any_angle(rng))
    size = between(rng, 0.03, 0.08)
    return AreaLamp(place, (0.0, TABLE, 0.0), size, size, between(rng, 0.01, 0.03) / size**2, swing)


def finish(rng: np.random.Generator) -> Material:
    """Return paint mostly, sometimes metal."""
    if rng.random() < 0.2:
        return Conductor(roughness=between(rng, 0.2, 0.35))
    return RoughPlastic(common.surface(rng, 0.08, 0.85), between(rng, 0.2, 0.4))
