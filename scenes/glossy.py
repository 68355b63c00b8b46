"""Makes reflections: metal and lacquered bodies on a shiny table, with highlights unlike their motion."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Conductor, Material, Mesh, RoughPlastic, Scene, Spin, Translation
from qsim.scene.props import gear
from qsim.scene.rotation import exponential, pose_matrix
from qsim.scene.shapes import ball, blob, box, cylinder, moved, polyhedron, torus
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign

TABLE = -0.09  # m, height of its top


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return six to nine bodies of 6 to 10 cm that slide at 1.5 to 4 m/s with 2 to 8 turns a second at speed 1."""
    rng = np.random.default_rng([seed, 9])
    top = RoughPlastic(common.backdrop(rng, 0.05, 0.5), between(rng, 0.08, 0.2))
    bodies = [
        common.floor(top, 1.8, y=TABLE, z=-0.3),
        common.wall(RoughPlastic(common.backdrop(rng, 0.1, 0.6), 0.3), 2.4, 1.2, z=-0.7),
    ]
    count = int(rng.integers(6, 10))
    tracks = rng.permutation(np.linspace(-0.3, 0.2, count))
    for i, z in enumerate(tracks):
        solid = shape(rng, between(rng, 0.03, 0.05))
        velocity = speed * between(rng, 1.5, 4.0) * sign(rng)
        middle = between(rng, -0.22, 0.22) * (0.3 if i < 2 else 1.0)
        height = TABLE - float(solid.vertices[:, 1].min())
        slide = Translation((velocity, 0.0, 0.0), (middle - velocity * common.CLIP / 2, height, float(z)))
        turn = Spin((0, 1, 0), speed * between(rng, 12, 50) * sign(rng), any_angle(rng))
        bodies.append(Body(f"thing {i}", solid, finish(rng), slide @ turn))
    view = common.camera((between(rng, -0.15, 0.15), between(rng, 0.14, 0.3), 0.65), (0, -0.03, -0.05), 0.5)
    return Scene("glossy", seed, view, (common.studio(rng),), tuple(bodies), speed)


def shape(rng: np.random.Generator, size: float) -> Mesh:
    """Return a solid on the table whose rotation about the vertical is visible by shape or texture."""
    kind = int(rng.integers(6))
    if kind == 0:
        return box(2 * size, between(rng, 1, 3) * size, 1.4 * size, 2 * size)
    if kind == 1:
        return moved(torus(size, 0.35 * size), pose_matrix(exponential((np.pi / 2, 0, 0))))  # on its edge
    if kind == 2:
        return blob(rng, size, 0.2)
    if kind == 3:
        return polyhedron(rng, 1.2 * size, int(rng.integers(6, 16)), 2 * size)
    if kind == 4:
        return gear(int(rng.integers(8, 16)), 1.3 * size, 0.7 * size, spokes=4)
    return cylinder(size, 2 * size, 64, taper=pick(rng, (1.0, 0.6))) if rng.random() < 0.5 else ball(size, 64)


def finish(rng: np.random.Generator) -> Material:
    """Return aluminium, chromium, gold or copper of random polish, or lacquer over a pattern."""
    if rng.random() < 0.5:
        eta, k = pick(rng, ((0.96, 6.70), (3.12, 3.31), (0.42, 2.35), (1.04, 2.59)))
        return Conductor(eta, k, between(rng, 0.04, 0.2))
    return RoughPlastic(common.surface(rng, 0.03, 0.8), between(rng, 0.04, 0.12))
