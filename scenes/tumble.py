"""Free flight: shapes thrown into the air tumble under sun and sky over a textured ground."""

from __future__ import annotations

import numpy as np

from qsim.motion import Ballistic
from qsim.parts import gear
from qsim.rotation import vector
from qsim.scene import Body, Diffuse, Mesh, Scene
from qsim.shapes import ball, blob, box, cylinder, polyhedron, torus
from scenes import stage


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Six to nine shapes of 10 to 20 cm, thrown at 3 to 7 m/s, 3 to 8 turns per second at speed 1."""
    rng = np.random.default_rng([seed, 2])
    count = int(rng.integers(6, 10))
    bodies = [
        stage.floor(Diffuse(stage.backdrop(rng)), 8.0, y=-0.75, z=-1.0),
        stage.wall(Diffuse(stage.backdrop(rng)), 9.0, 1.6, z=-2.4, y=0.0),
    ]
    places = spread(rng, count)
    for i, place in enumerate(places):
        velocity = rng.standard_normal(3) * (3.0, 2.5, 0.6) * speed
        motion = Ballistic(
            vector(place - velocity * stage.CLIP / 2),
            vector(velocity),
            axis=stage.direction(rng),
            rate=speed * float(rng.uniform(20, 50)),
            phase=float(rng.uniform(0, 6.28)),
        )
        bodies.append(Body(f"shape {i}", shape(rng), stage.paint(rng, stage.surface(rng)), motion))
    view = stage.camera((0.0, float(rng.uniform(0.0, 0.5)), 2.6), (0, 0, 0), 0.5)
    return Scene("tumble", seed, view, (stage.sun(rng),), tuple(bodies), speed)


def spread(rng: np.random.Generator, count: int) -> np.ndarray:
    """Places [count, 3] in the view's middle that keep apart from one another in x, y."""
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform((-0.95, -0.42, -0.3), (0.95, 0.42, 0.4))
        if len(places) < 3:  # the square in the middle is never empty
            place[0] *= 0.4
        if all(np.hypot(*(place - other)[:2]) > 0.27 for other in places):
            places.append(place)
    return np.array(places)


def shape(rng: np.random.Generator) -> Mesh:
    """One solid, about 20 cm across."""
    kind, size = int(rng.integers(7)), float(rng.uniform(0.09, 0.14))
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
        return cylinder(0.8 * size, 2.2 * size, taper=stage.pick(rng, (1.0, 0.0, 0.5)))
    if kind == 5:
        return gear(int(rng.integers(8, 18)), 1.2 * size, 0.6 * size, spokes=int(rng.integers(0, 2)) * 4)
    return ball(size)
