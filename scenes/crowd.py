"""Makes a crowd: dozens of small bodies hop across a square in crossing streams, with many occlusions."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Diffuse, Mesh, Oscillation, Scene, Spin, Translation
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, blob, box, cylinder, polyhedron
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return sixty to ninety bodies of 3 to 5 cm in three streams of 1.5 to 4 m/s at speed 1."""
    rng = np.random.default_rng([seed, 16])
    bodies = [
        common.floor(Diffuse(common.backdrop(rng)), 2.4, y=0.0, z=-0.3),
        common.wall(Diffuse(common.backdrop(rng)), 2.8, 1.4, z=-0.9),
    ]
    coats = [common.paint(rng, common.surface(rng)) for _ in range(8)]
    headings = any_angle(rng) + np.array([0.0, 2.1, 4.2]) + rng.normal(0, 0.3, 3)
    rates = rng.uniform(2.2, 3.8, 3)
    for i in range(int(rng.integers(60, 91))):
        stream = int(rng.integers(3))
        angle = headings[stream] + rng.normal(0, 0.15)
        rate = speed * rates[stream] * rng.uniform(0.7, 1.2)
        velocity = rate * np.array([np.cos(angle), 0.0, np.sin(angle)])
        solid = shape(rng, between(rng, 0.012, 0.024))
        ground = -float(solid.vertices[:, 1].min()) + 0.008
        middle = np.array([rng.uniform(-0.42, 0.42), ground, rng.uniform(-0.6, 0.2)])
        walk = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
        hop = Oscillation((0.0, 0.008, 0.0), speed * between(rng, 4, 12), any_angle(rng))
        turn = Spin((0, 1, 0), speed * between(rng, 5, 30) * sign(rng), any_angle(rng))
        bodies.append(Body(f"body {i}", solid, pick(rng, coats), walk @ hop @ turn))
    view = common.camera((between(rng, -0.15, 0.15), between(rng, 0.25, 0.4), 0.5), (0, 0.02, -0.12), 0.5)
    return Scene("crowd", seed, view, (common.sun(rng, 0.6, 1.0),), tuple(bodies), speed)


def shape(rng: np.random.Generator, size: float) -> Mesh:
    """Return a small mesh of few triangles."""
    kind = int(rng.integers(5))
    if kind == 0:
        width, height, depth = size * rng.uniform(1.0, 2.6, 3)
        return box(width, height, depth, 3 * size)
    if kind == 1:
        return ball(size, 24)
    if kind == 2:
        return blob(rng, size, 0.2, 24)
    if kind == 3:
        return cylinder(0.7 * size, 2.4 * size, 20, taper=pick(rng, (1.0, 0.3)))
    return polyhedron(rng, 1.2 * size, int(rng.integers(6, 14)), 3 * size)
