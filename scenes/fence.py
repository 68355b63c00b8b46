"""Makes occlusions: bodies pass behind a moving fence and behind one another."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Diffuse, Mesh, Scene, Spin, Texture, Translation, textures
from qsim.scene.rotation import exponential, pose_matrix, vector
from qsim.scene.shapes import blob, box, merged, moved
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return a sliding fence before three layers of bodies, in both directions at 1 to 4 m/s at speed 1."""
    rng = np.random.default_rng([seed, 5])
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.06, 0.45)), 1.8, 0.9, z=-0.45)]
    for i in range(int(rng.integers(5, 8))):
        z = between(rng, -0.3, -0.05)
        velocity = np.array([sign(rng) * rng.uniform(1.5, 3.5), rng.normal(0, 0.4), 0.0]) * speed
        middle = np.array([rng.uniform(-0.34, 0.34) * (0.4 if i < 3 else 1.0), rng.uniform(-0.12, 0.12), z])
        motion = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
        turn = Spin(common.direction(rng), speed * between(rng, 5, 25), any_angle(rng))
        size = between(rng, 0.04, 0.07)
        solid = blob(rng, size, 0.2) if rng.random() < 0.5 else box(1.5 * size, 1.5 * size, 1.5 * size, 2 * size)
        bodies.append(Body(f"passer {i}", solid, common.paint(rng, common.surface(rng)), motion @ turn))
    slide = speed * between(rng, 0.8, 2.0) * sign(rng)
    wood = textures.levels(textures.rings(rng, between(rng, 8, 20)), between(rng, 0.3, 0.5), between(rng, 0.6, 0.9))
    slats = Body(
        "fence",
        fence(rng),
        Diffuse(Texture(wood)),
        Translation((slide, 0.0, 0.0), (-slide * common.CLIP / 2, 0, 0)),
    )
    view = common.camera((0.0, between(rng, -0.05, 0.1), 0.7), (0, 0, 0), 0.5)
    return Scene("fence", seed, view, (common.sun(rng, 0.6, 1.0),), (*bodies, slats), speed)


def fence(rng: np.random.Generator) -> Mesh:
    """Return slats with gaps, tilted by a random angle, with two rails."""
    pitch = between(rng, 0.05, 0.1)
    share = between(rng, 0.25, 0.42)
    lean = float(rng.choice([0.0, 0.0, 0.3, -0.5]))
    slats = [
        moved(box(pitch * share, 0.7, 0.008, 0.7), pose_matrix(exponential((0, 0, lean)), (x, 0, 0.05)))
        for x in np.arange(-0.8, 0.8, pitch)
    ]
    rails = [moved(box(2.0, 0.014, 0.008, 0.7), pose_matrix(None, (0, y, 0.042))) for y in (-0.11, 0.11)]
    return merged([*slats, *rails])
