"""Makes low texture: uniform grey bodies before uniform walls, with motion visible by edges and shading only."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Constant, Diffuse, Mesh, RoughPlastic, Scene, Spin, Translation
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, blob, box, cylinder, polyhedron, torus
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return five to eight bodies of 6 to 14 cm at 1 to 4 m/s and 1 to 6 turns a second at speed 1."""
    rng = np.random.default_rng([seed, 11])
    bodies = [
        common.floor(Diffuse(between(rng, 0.2, 0.7)), 2.4, y=-0.16, z=-0.3),
        common.wall(Diffuse(between(rng, 0.15, 0.75)), 2.4, 1.2, z=-0.4, y=0.3),
    ]
    count = int(rng.integers(5, 9))
    xs = rng.permutation(np.linspace(-0.27, 0.27, count)) + rng.normal(0, 0.015, count)
    for i, x in enumerate(xs):
        velocity = speed * np.array([sign(rng) * rng.uniform(1.0, 3.5), rng.normal(0, 1.0), 0.0])
        middle = np.array([x, rng.uniform(-0.08, 0.09), rng.uniform(-0.2, 0.08)])
        flight = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
        turn = Spin(common.direction(rng), speed * between(rng, 8, 35), any_angle(rng))
        grey = between(rng, 0.04, 0.85)
        coat = Diffuse(grey) if rng.random() < 0.7 else RoughPlastic(grey, 0.3)
        bodies.append(Body(f"body {i}", shape(rng, between(rng, 0.035, 0.06)), coat, flight @ turn))
    view = common.camera((between(rng, -0.15, 0.15), between(rng, 0.02, 0.2), 0.65), (0, 0, 0), 0.5)
    lights = (Constant(between(rng, 0.15, 0.4)), common.lamp(rng, (0, 0, 0), 1.2, 2.0))
    return Scene("plain", seed, view, lights, tuple(bodies), speed)


def shape(rng: np.random.Generator, size: float) -> Mesh:
    """Return a body whose outline or facets change with rotation, or sometimes a ball, which shows none."""
    kind = int(rng.integers(7))
    if kind <= 1:
        return box(*(size * rng.uniform(0.8, 2.4, 3)))
    if kind == 2:
        return torus(size, 0.4 * size)
    if kind == 3:
        return blob(rng, size, 0.25)
    if kind == 4:
        return cylinder(0.7 * size, 2.4 * size, 48, taper=pick(rng, (1.0, 0.0)))
    if kind == 5:
        return polyhedron(rng, 1.2 * size, int(rng.integers(5, 12)))
    return ball(size)
