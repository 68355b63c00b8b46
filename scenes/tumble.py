"""Makes free flight: tumbling bodies under sun and sky over a textured ground."""

from __future__ import annotations

import numpy as np

from qsim.scene import Ballistic, Body, Diffuse, Mesh, Scene
from qsim.scene.props import gear
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, blob, box, cylinder, polyhedron, torus
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return six to nine toys of 4 to 7 cm, thrown at 1 to 4 m/s, 3 to 8 turns per second at speed 1."""
    rng = np.random.default_rng([seed, 2])
    count = int(rng.integers(6, 10))
    bodies = [
        common.floor(Diffuse(common.backdrop(rng)), 2.4, y=-0.18, z=-0.2),
        common.wall(Diffuse(common.backdrop(rng)), 2.4, 1.2, z=-0.6, y=0.35),
    ]
    for i, place in enumerate(spread(rng, count)):
        motion = thrown(rng, place, speed)
        bodies.append(Body(f"toy {i}", shape(rng), common.paint(rng, common.surface(rng)), motion))
    view = common.camera((0.0, between(rng, 0.02, 0.14), 0.65), (0, 0, 0), 0.5)
    return Scene("tumble", seed, view, (common.sun(rng),), tuple(bodies), speed)


def spread(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return positions [count, 3] in the view, apart from one another in x, y; three in the central square."""
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform((-0.24, -0.1, -0.08), (0.24, 0.11, 0.1))
        if len(places) < 3:
            place[0] *= 0.4
        if all(np.hypot(*(place - other)[:2]) > 0.068 for other in places):
            places.append(place)
    return np.array(places)


def shape(rng: np.random.Generator) -> Mesh:
    """Return one solid, about 5 cm across."""
    kind = int(rng.integers(7))
    size = between(rng, 0.022, 0.036)
    if kind == 0:
        width, height, depth = size * rng.uniform(0.9, 1.9, 3)
        return box(width, height, depth, 2 * size)
    if kind == 1:
        return torus(size, 0.4 * size)
    if kind == 2:
        return blob(rng, size, 0.2)
    if kind == 3:
        return polyhedron(rng, 1.2 * size, int(rng.integers(5, 14)), 2 * size)
    if kind == 4:
        return cylinder(0.8 * size, 2.2 * size, taper=pick(rng, (1.0, 0.0, 0.5)))
    if kind == 5:
        return gear(int(rng.integers(8, 18)), 1.2 * size, 0.6 * size, spokes=int(rng.integers(0, 2)) * 4)
    return ball(size)


def thrown(rng: np.random.Generator, place: np.ndarray, speed: float) -> Ballistic:
    """Return a throw that passes `place` in the middle of a clip, at 1 to 4 m/s, 3 to 8 turns per second at speed 1."""
    velocity = rng.standard_normal(3) * (1.8, 1.4, 0.3) * speed
    return Ballistic(
        vector(place - velocity * common.CLIP / 2),
        vector(velocity),
        axis=common.direction(rng),
        rate=speed * between(rng, 20, 50),
        phase=any_angle(rng),
    )
