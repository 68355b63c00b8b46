"""Makes periodic textures: striped and chequered drums turn before a lattice, alike after every period."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Diffuse, Oscillation, Scene, Spin, Still, Texture, textures
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, cylinder
from qsim.scene.textures import Picture
from qsim.scenes import common
from qsim.scenes.common import between, pick, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return four or five drums, 6 to 11 turns per second at speed 1; the lattice behind oscillates."""
    rng = np.random.default_rng([seed, 8])
    slide = speed * between(rng, 10, 14)
    back = common.wall(Diffuse(Texture(pattern(rng), (6.0, 3.0))), 1.8, 0.9)
    bodies = [
        Body(
            "lattice",
            back.mesh,
            back.material,
            Oscillation((0.06 * sign(rng), 0.02, 0), slide, between(rng, -1.2, 0.2), (0, 0, -0.25)),
        )
    ]
    xs = np.linspace(-0.3, 0.3, int(rng.integers(4, 6))) + rng.uniform(-0.02, 0.02)
    for i, x in enumerate(xs):
        radius = between(rng, 0.045, 0.07)
        solid = (
            cylinder(radius, between(rng, 0.15, 0.26), 64, pick(rng, (1.0, 1.0, 0.6)))
            if rng.random() < 0.75
            else ball(1.2 * radius, 64)
        )
        place = Still((float(x), between(rng, -0.03, 0.03), between(rng, -0.06, 0.06)), vector(rng.normal(0, 0.35, 3)))
        rate = speed * between(rng, 38, 70) * sign(rng)
        repeat = (float(rng.integers(1, 3)), float(rng.integers(1, 3)))
        coat = common.paint(rng, Texture(pattern(rng), repeat))
        bodies.append(Body(f"drum {i}", solid, coat, place @ Spin((0, 1, 0), rate)))
    view = common.camera((between(rng, -0.1, 0.1), between(rng, 0.0, 0.15), 0.7), (0, 0, 0), 0.5)
    return Scene("drums", seed, view, (common.studio(rng), common.lamp(rng, (0, 0, 0), 0.9, 1.5)), tuple(bodies), speed)


def pattern(rng: np.random.Generator) -> Picture:
    """Return stripes, checks or dots without random detail."""
    low = between(rng, 0.03, 0.2)
    high = between(rng, 0.55, 0.85)
    kind = int(rng.integers(4))
    if kind == 0:
        return textures.stripes(int(rng.integers(8, 20)), low, high, duty=between(rng, 0.3, 0.7))
    if kind == 1:
        return textures.checker(2 * int(rng.integers(3, 8)), 2 * int(rng.integers(3, 8)), low, high)
    if kind == 2:
        return textures.dots(int(rng.integers(6, 14)), low, high)
    return np.ascontiguousarray(textures.stripes(int(rng.integers(6, 16)), low, high).T)
