"""Makes fast, small motion: pellets of a few pixels shoot across the view."""

from __future__ import annotations

import numpy as np

from qsim.scene import Ballistic, Body, Conductor, Diffuse, Material, RoughPlastic, Scene
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, polyhedron
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return forty to seventy pellets of 4 to 12 mm in two or three jets, 2 to 5 m/s at speed 1."""
    rng = np.random.default_rng([seed, 4])
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.15, 0.45)), 1.2, 0.6, z=-0.12)]
    jets = [(any_angle(rng), between(rng, 2.0, 4.2)) for _ in range(int(rng.integers(2, 4)))]
    for i in range(int(rng.integers(40, 70))):
        angle, fast = pick(rng, jets)
        angle += float(rng.normal(0, 0.15))
        velocity = speed * fast * between(rng, 0.8, 1.2) * np.array([np.cos(angle), np.sin(angle), rng.normal(0, 0.1)])
        middle = rng.uniform((-0.3, -0.15, -0.08), (0.3, 0.15, 0.1))
        motion = Ballistic(
            vector(middle - velocity * common.CLIP / 2),
            vector(velocity),
            common.direction(rng),
            speed * rng.uniform(0, 120),
        )
        size = between(rng, 0.002, 0.006)
        solid = ball(size, 24) if rng.random() < 0.5 else polyhedron(rng, 1.2 * size, 8, 2 * size)
        bodies.append(Body(f"pellet {i}", solid, coat(rng), motion))
    view = common.camera((between(rng, -0.1, 0.1), between(rng, -0.05, 0.1), 0.65), (0, 0, 0), 0.5)
    return Scene(
        "pellets", seed, view, (common.studio(rng), common.lamp(rng, (0, 0, 0), 0.8, 1.0)), tuple(bodies), speed
    )


def coat(rng: np.random.Generator) -> Material:
    """Return steel, white or dark."""
    if rng.random() < 0.3:
        return Conductor(roughness=0.2)
    return RoughPlastic(float(pick(rng, (0.03, 0.05, 0.8, 0.9))), 0.2)
