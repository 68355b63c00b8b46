"""Makes deforming cloth: one or two printed flags in a gale, seen from the side, before a textured wall."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Conductor, Diffuse, Flag, Motion, Oscillation, Ripple, Scene, Still
from qsim.scene.rotation import pose_matrix
from qsim.scene.shapes import cylinder, moved, sheet
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return flags with waves of 5 to 40 cm at 2 to 6 m/s at speed 1, on vibrating poles."""
    rng = np.random.default_rng([seed, 15])
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.08, 0.45)), 2.4, 1.2, z=-0.5)]
    count = int(rng.integers(1, 3))
    for i in range(count):
        width = between(rng, 0.42, 0.5) if count == 1 else between(rng, 0.3, 0.36)
        height = between(rng, 0.22, 0.26) if count == 1 else between(rng, 0.16, 0.22)
        # Waves move the cloth across its plane, which shows in the picture at an angle
        yaw = between(rng, 0.7, 0.95) * sign(rng)
        middle = 0.0 if count == 1 else (i - 0.5) * 0.32
        x = middle - 0.5 * width * np.cos(yaw)
        tremble = Oscillation((0.02, 0.004, 0.0), speed * between(rng, 12, 18), any_angle(rng))
        pole: Motion = tremble @ Still(
            (x, between(rng, -0.02, 0.02), 0.5 * width * np.sin(yaw) - 0.06), common.upright(yaw)
        )
        cloth = moved(sheet(width, height, 64, 32), pose_matrix(None, (width / 2, 0, 0)))
        flag = Flag(cloth.vertices, ripples(rng, width, speed), pole)
        bodies.append(Body(f"flag {i}", cloth, Diffuse(common.surface(rng, 0.1, 0.9)), flag))
        bodies.append(Body(f"pole {i}", cylinder(0.005, 0.8, 24), Conductor(roughness=0.3), pole))
    view = common.camera((between(rng, -0.08, 0.08), between(rng, -0.05, 0.12), 0.65), (0, 0, 0), 0.5)
    return Scene("flag", seed, view, (common.sun(rng, 0.5, 0.9),), tuple(bodies), speed)


def ripples(rng: np.random.Generator, width: float, speed: float) -> tuple[Ripple, ...]:
    """Return a long wave and two shorter, lower and faster ones."""
    return tuple(
        Ripple(
            amplitude=width * share * between(rng, 0.8, 1.2),
            wavelength=width * length * between(rng, 0.8, 1.2),
            frequency=speed * between(rng, low, high),
            slant=float(rng.normal(0, 6)),
            phase=any_angle(rng),
        )
        for share, length, low, high in ((0.14, 0.9, 20, 26), (0.05, 0.5, 24, 34), (0.02, 0.3, 30, 44))
    )
