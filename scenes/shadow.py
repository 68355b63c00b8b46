"""Makes moving shadows on a wall at rest: blades, slats and leaves outside the view cross the sun."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Diffuse, Mesh, Motion, Oscillation, Scene, Spin, Still, SunSky, Translation
from qsim.scene.props import rotor
from qsim.scene.rotation import pose_matrix, rotation_between, vector
from qsim.scene.shapes import blob, box, merged, moved, polyhedron
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return two or three bodies before the sun at 1 to 5 m/s, and one small flyer in view."""
    rng = np.random.default_rng([seed, 14])
    sun = SunSky(between(rng, 0.75, 1.0), between(rng, -0.8, 0.8), 6 * between(rng, 0.8, 1.3), between(rng, 0.6, 1.5))
    towards = np.array(
        [
            np.cos(sun.elevation) * np.sin(sun.azimuth),
            np.sin(sun.elevation),
            np.cos(sun.elevation) * np.cos(sun.azimuth),
        ]
    )
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.1, 0.75)), 1.6, 0.8)]
    for i in range(3):  # bodies at rest before the wall
        place = pose_matrix(None, (between(rng, -0.28, 0.28), between(rng, -0.12, 0.12), 0.02))
        thing = moved(blob(rng, between(rng, 0.015, 0.03), 0.2), place)
        bodies.append(Body(f"stone {i}", thing, common.paint(rng, common.surface(rng))))
    facing = Still.turned(rotation_between((0, 0, 1), towards))
    for i, aside in enumerate(rng.permutation([-0.16, 0.02, 0.2])[: int(rng.integers(2, 4))]):
        at = Translation((0, 0, 0), vector(np.array([aside, 0.0, 0.0]) + between(rng, 0.42, 0.55) * towards))
        solid, motion = caster(rng, speed)
        bodies.append(Body(f"caster {i}", solid, Diffuse(0.3), at @ facing @ motion))
    velocity = speed * np.array([sign(rng) * rng.uniform(1.5, 3.5), rng.normal(0, 0.8), 0.0])
    middle = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.06, 0.06), 0.08])
    flight = Translation(vector(velocity), vector(middle - velocity * common.CLIP / 2))
    turn = Spin(common.direction(rng), speed * between(rng, 15, 40), any_angle(rng))
    flyer = polyhedron(rng, between(rng, 0.018, 0.03), 8, 0.04)
    bodies.append(Body("flyer", flyer, common.paint(rng, common.surface(rng)), flight @ turn))
    view = common.camera((between(rng, -0.08, 0.08), between(rng, -0.08, 0.02), 0.65), (0, 0, 0), 0.5)
    return Scene("shadow", seed, view, (sun,), tuple(bodies), speed)


def caster(rng: np.random.Generator, speed: float) -> tuple[Mesh, Motion]:
    """Return mesh and motion in the plane z = 0 before the sun: a rotor, sliding slats or a branch with leaves."""
    kind = int(rng.integers(3))
    if kind == 0:
        blades = rotor(int(rng.integers(3, 7)), between(rng, 0.09, 0.14), 0.2, between(rng, 0.4, 0.7))
        return blades, Spin((0, 0, 1), speed * between(rng, 15, 40) * sign(rng), any_angle(rng))
    if kind == 1:
        pitch = between(rng, 0.02, 0.045)
        slats = merged(
            [moved(box(0.4 * pitch, 0.22, 0.004), pose_matrix(None, (k * pitch, 0, 0))) for k in range(-5, 6)]
        )
        amplitude = (between(rng, 0.03, 0.06), between(rng, 0.0, 0.02), 0.0)
        return slats, Oscillation(amplitude, speed * between(rng, 6, 12), any_angle(rng))
    leaves = [
        moved(
            blob(rng, 1.0, 0.15, 16),
            pose_matrix(
                np.diag(rng.uniform((0.008, 0.015, 0.002), (0.015, 0.035, 0.003))), (*rng.normal(0, 0.06, 2), 0)
            ),
        )
        for _ in range(int(rng.integers(12, 25)))
    ]
    sway = (between(rng, 0.02, 0.05) * pick(rng, (-1, 1)), between(rng, 0.01, 0.03), 0.0)
    return merged(leaves), Oscillation(sway, speed * between(rng, 6, 12), any_angle(rng))
