"""Makes a close-up: small things seen by a fast lens that blurs, distorts and darkens, on the path of a hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.scene import Body, Diffuse, Keyframes, Mesh, Motion, Scene, Spin, Still
from qsim.scene.rotation import vector
from qsim.scene.shapes import ball, blob, box, cylinder, polyhedron
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign

PITCH = 6e-6  # m
# poses of the path, s between two at speed 1; it is walked back and forth
KEYS = 12
STEP = 0.04


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return things on a table, 0.15 to 0.6 m away; the camera wanders by some centimetres, every third thing turns."""
    rng = np.random.default_rng([seed, 20])
    bodies = [
        common.floor(Diffuse(common.backdrop(rng, 0.1, 0.7)), 1.0, z=-0.2),
        common.wall(Diffuse(common.backdrop(rng, 0.1, 0.7)), 1.2, 0.5, z=-0.35, y=0.1),
        *things(rng, speed),
    ]
    lights = (common.studio(rng, 0.4), common.lamp(rng, (0, 0, 0), 0.9, 2.0))
    return Scene("macro", seed, view(rng, speed), lights, tuple(bodies), speed)


def things(rng: np.random.Generator, speed: float) -> list[Body]:
    """Return nine small bodies in three rows: near, in focus, and far."""
    bodies = []
    for i in range(9):
        solid = small(rng)
        x = 0.055 * (i % 3 - 1) * (1 + i // 3 / 2) + rng.normal(0, 0.008)
        place = Still((float(x), -float(solid.vertices[:, 1].min()), 0.1 - 0.13 * (i // 3) + between(rng, -0.02, 0.02)))
        turn: Motion = Spin((0, 1, 0), speed * between(rng, 30, 60) * sign(rng), any_angle(rng))
        bodies.append(
            Body(f"thing {i}", solid, common.paint(rng, common.surface(rng)), place @ turn if i % 3 == 1 else place)
        )
    return bodies


def small(rng: np.random.Generator) -> Mesh:
    """Return a body of two to five centimetres."""
    size = between(rng, 0.012, 0.022)
    return (
        ball(size, 48),
        box(1.6 * size, 2 * size, 1.6 * size, 1.6 * size),
        cylinder(0.7 * size, 2.2 * size, 48),
        polyhedron(rng, size, texture_size=size),
        blob(rng, size),
    )[int(rng.integers(5))]


def view(rng: np.random.Generator, speed: float) -> Camera:
    """Return a camera at f/1.4 that focuses on the middle row, with barrel distortion and dark corners."""
    still = common.camera((between(rng, -0.04, 0.04), between(rng, 0.07, 0.12), 0.26), (0.0, 0.012, -0.03), 0.5)
    lens = Lens(between(rng, -0.3, -0.12), between(rng, 0.0, 0.05), (between(rng, -0.7, -0.3),))
    focus = float(np.linalg.norm(np.subtract(still.target, still.origin)))
    behind = still.focal_pixels * PITCH  # m, from the lens to the pixels
    return replace(
        still,
        focal_length=behind * focus / (behind + focus),
        f_number=1.4,
        pixel_pitch=PITCH,
        aperture_blur=True,
        focus_distance=focus,
        lens=lens,
        motion=wandering(rng, speed),
    )


def wandering(rng: np.random.Generator, speed: float) -> BackAndForth:
    """Return a path through random poses, to the right and to the left in turn, at 0.5 to 1.2 m/s at speed 1."""
    side = sign(rng) * (-1.0) ** np.arange(KEYS)
    across = side * rng.uniform(0.01, 0.022, KEYS)
    places = np.column_stack([across, rng.normal(0, 0.004, KEYS), rng.normal(0, 0.008, KEYS)])
    turns = rng.normal(0, (0.02, 0.02, 0.04), (KEYS, 3))
    order = np.abs((np.arange(2 * KEYS + 1) + KEYS - 1) % (2 * KEYS - 2) - (KEYS - 1))  # 0 ... 11 ... 0, 1, 2
    times = STEP / speed * np.arange(len(order))
    path = Keyframes(tuple(times.tolist()), tuple(map(vector, places[order])), tuple(map(vector, turns[order])))
    return BackAndForth(path)


@dataclass(frozen=True)
class BackAndForth(Motion):
    """A path that never ends: to its last pose, back to the first, and again. Before time 0 it rests.

    `path` leads there, back, and to the third pose again, so that its second pose is also the one before its last.
    """

    path: Keyframes

    def pose(self, t: float) -> Array:
        return self.path.pose(self._within(t))

    def velocity(self, t: float) -> tuple[Array, Array]:
        return self.path.velocity(self._within(t))

    def _within(self, t: float) -> float:
        """Return a time [s] of the path with the pose of time t."""
        first = self.path.times[1]
        last = self.path.times[-2]
        return t if t <= last else first + (t - last) % (last - first)
