"""Makes refraction: clear and frosted bodies before a textured wall, which moves unlike their surfaces."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Dielectric, Diffuse, Mesh, Scene, Spin, Translation
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, blob, box, cylinder, polyhedron, torus
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return four to six glass and two painted bodies of 4 to 10 cm, 1.5 to 4 m/s, 1 to 5 turns a second at speed 1."""
    rng = np.random.default_rng([seed, 10])
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.05, 0.85)), 1.6, 0.8, z=-0.25)]
    clear = int(rng.integers(4, 7))
    depths = rng.permutation(np.linspace(-0.1, 0.12, clear + 2))
    for i, z in enumerate(depths):
        velocity = speed * np.array([sign(rng) * rng.uniform(1.5, 4.0), rng.normal(0, 0.7), 0.0])
        middle = np.array([rng.uniform(-0.26, 0.26) * (0.35 if i < 3 else 1.0), rng.uniform(-0.09, 0.09), z])
        flight = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
        turn = Spin(common.direction(rng), speed * between(rng, 8, 30), any_angle(rng))
        size = between(rng, 0.028, 0.05)
        if i < clear:
            roughness = 0.0 if rng.random() < 0.7 else between(rng, 0.05, 0.15)
            glass = Dielectric(between(rng, 1.33, 1.7), roughness)
            bodies.append(Body(f"glass {i}", shape(rng, size), glass, flight @ turn))
        else:
            painted = common.paint(rng, common.surface(rng))
            bodies.append(Body(f"painted {i}", shape(rng, 0.7 * size), painted, flight @ turn))
    view = common.camera((between(rng, -0.12, 0.12), between(rng, -0.06, 0.12), 0.65), (0, 0, 0), 0.5)
    return Scene("glass", seed, view, (common.studio(rng, 0.8),), tuple(bodies), speed)


def shape(rng: np.random.Generator, size: float) -> Mesh:
    """Return a lens, prism, ring or drop."""
    kind = int(rng.integers(6))
    if kind == 0:
        return ball(size, 64)
    if kind == 1:
        return torus(size, 0.4 * size)
    if kind == 2:
        return polyhedron(rng, 1.2 * size, int(rng.integers(6, 20)), 2 * size)
    if kind == 3:
        return blob(rng, size, 0.12)
    if kind == 4:
        return cylinder(0.9 * size, 2 * size, 64)
    return box(2 * size, 1.6 * size, 0.5 * size, 2 * size)
