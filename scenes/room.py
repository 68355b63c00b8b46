"""Makes egomotion: the camera alone pans, shakes or flies through a furnished room."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Constant, Diffuse, Motion, Scene, Shake, Spin, Translation, Wave, textures
from qsim.scene.rotation import exponential, pose_matrix, vector
from qsim.scene.shapes import ball, box, cylinder, moved, sheet
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign

# m
WIDTH = 4.0
HEIGHT = 2.6
DEPTH = 5.0


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return, by seed, a pan of 4 to 9 rad/s, a shake of two degrees at 18 to 32 Hz, a flight at 9 to 18 m/s."""
    rng = np.random.default_rng([seed, 13])
    bodies = [*walls(rng), *furniture(rng)]
    origin = np.array([between(rng, -0.3, 0.3), between(rng, 1.2, 1.6), 2.2])
    target = np.array([between(rng, -0.4, 0.4), between(rng, 0.9, 1.2), -1.5])
    view = common.camera(origin, target, between(rng, 0.6, 0.8), (pan, shake, flight)[seed % 3](rng, speed))
    lights = (Constant(between(rng, 0.3, 0.6)), common.lamp(rng, (0, 1, -1), 3.0, 12.0))
    return Scene("room", seed, view, lights, tuple(bodies), speed)


def pan(rng: np.random.Generator, speed: float) -> Motion:
    """Return a rotation about a near-vertical axis through the lens, at its middle at half of a clip."""
    rate = speed * between(rng, 4.0, 9.0) * sign(rng)
    return Spin((float(rng.normal(0, 0.3)), 1.0, 0.0), rate, -rate * common.CLIP / 2)


def shake(rng: np.random.Generator, speed: float) -> Motion:
    """Return the shake of a hand: three waves about all axes and one translation."""
    turns = tuple(
        Wave(vector(rng.normal(0, (0.04, 0.04, 0.02))), speed * between(rng, 18, 32), any_angle(rng)) for _ in range(3)
    )
    return Shake(turns, (Wave(vector(rng.normal(0, 0.01, 3)), speed * between(rng, 8, 15), any_angle(rng)),))


def flight(rng: np.random.Generator, speed: float) -> Motion:
    """Return a drone's motion: forward and sideways."""
    velocity = speed * np.array([between(rng, 8, 14) * sign(rng), between(rng, -1, 1), between(rng, 4, 12)])
    return Translation(vector(velocity), vector(-velocity * common.CLIP / 2))


def walls(rng: np.random.Generator) -> list[Body]:
    """Return floor, back and side walls without a ceiling; the light comes from above and behind."""
    quarter = np.pi / 2
    sides = {
        "floor": (WIDTH, DEPTH, exponential((-quarter, 0, 0)), (0.0, 0.0, 0.0)),
        "back": (WIDTH, HEIGHT, np.eye(3), (0.0, HEIGHT / 2, -DEPTH / 2)),
        "left": (DEPTH, HEIGHT, exponential((0, quarter, 0)), (-WIDTH / 2, HEIGHT / 2, 0.0)),
        "right": (DEPTH, HEIGHT, exponential((0, -quarter, 0)), (WIDTH / 2, HEIGHT / 2, 0.0)),
    }
    return [
        Body(name, moved(sheet(width, height), pose_matrix(turn, place)), Diffuse(common.backdrop(rng, 0.1, 0.75)))
        for name, (width, height, turn, place) in sides.items()
    ]


def furniture(rng: np.random.Generator) -> list[Body]:
    """Return crates, pillars and balls on the floor, and pictures on the wall."""
    bodies = []
    for i in range(int(rng.integers(7, 12))):
        size = between(rng, 0.25, 0.55)
        kind = int(rng.integers(3))
        solid = (
            box(size * rng.uniform(0.6, 1.4), 2 * size, size, size),
            cylinder(0.4 * size, between(rng, 1.5, 4) * size),
            ball(0.8 * size, 64),
        )[kind]
        place = (between(rng, -1.5, 1.5), -float(solid.vertices[:, 1].min()), between(rng, -2.2, 0.4))
        at = pose_matrix(exponential((0, any_angle(rng), 0)), place)
        bodies.append(Body(f"piece {i}", moved(solid, at), common.paint(rng, common.surface(rng))))
    for i, x in enumerate((-1.2, 0.0, 1.2)):
        frame = moved(box(0.7, 0.7, 0.03, 0.7), pose_matrix(None, (x, between(rng, 1.2, 1.6), -DEPTH / 2 + 0.03)))
        picture = textures.photograph(pick(rng, common.PHOTOGRAPHS))
        bodies.append(Body(f"picture {i}", frame, Diffuse(picture)))
    return bodies
