"""A scene: a bar that turns before an even light."""

import numpy as np

from qsim.optics.camera import Camera
from qsim.scene import Body, Constant, Diffuse, Scene, Spin
from qsim.scene.shapes import box


def scene(seed=0, *, speed=1.0):
    rng = np.random.default_rng([seed, 9001])  # a number that no other family has
    camera = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1.1e-6, height=512, width=1024, origin=(0.0, 0.0, 3.0))
    turning = Spin(axis=(0.0, 0.0, 1.0), rate=speed * rng.uniform(100, 200))  # rad/s
    body = Body("bar", box(1.0, 0.2, 0.2), Diffuse(0.6), turning)  # metres
    return Scene("pendulum", seed, camera, (Constant(1.0),), (body,), speed)
