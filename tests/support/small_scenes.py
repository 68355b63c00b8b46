"""Small scenes for the tests of rendering: a 24 x 33 camera 4 m before squares in uniform light."""

from __future__ import annotations

import math

import numpy as np

from qsim.optics.camera import Camera, Pose
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Conductor, Constant, Diffuse, Light, Mesh, RoughPlastic, Scene, Still, SunSky, Texture

CAMERA = Camera(focal_length=2e-3, f_number=2.8, pixel_pitch=5e-5, height=24, width=33, origin=(0, 0, 4))
SKY = Constant(0.7)
CHEAP = Budget(samples=8, bounces=2)
RATE = 2000.0


def square(size: float = 1.0, z: float = 0.0) -> Mesh:
    """Return an upright square facing +z, textured once."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices = np.column_stack([corners * size / 2, np.full(4, z)])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), (corners + 1) / 2)


def scene(*bodies: Body, light: Light = SKY, camera: Camera = CAMERA) -> Scene:
    """Return bodies in one light."""
    return Scene("test", 0, camera, (light,), bodies)


def plate(motion: Pose | None, light: Light = SKY, camera: Camera = CAMERA) -> Scene:
    """Return a textured plate (body 1) before a grey wall (body 0)."""
    texture = Texture(0.2 + 0.6 * np.random.default_rng(5).random((6, 6)))
    wall = Body("wall", square(12, -1), Diffuse(0.3))
    return scene(wall, Body("plate", square(1.6), Diffuse(texture), motion), light=light, camera=camera)


def mirrored_sun() -> Scene:
    """Return a mirror on the ground that reflects the sun onto a wall, which paths find by chance only."""
    mirror = Body("mirror", square(4), Conductor(roughness=0.02), Still((0, -1, 1), (-math.pi / 2, 0, 0)))
    return scene(Body("wall", square(9, -1), RoughPlastic(0.5)), mirror, light=SunSky())


def renderer(made: Scene, budget: Budget = CHEAP, **options) -> Renderer:
    """Return a renderer at 2000 fps with few samples."""
    return Renderer(made, **({"budget": budget, "frame_rate": RATE} | options))
