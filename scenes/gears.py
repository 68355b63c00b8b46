"""Makes coupled rotation: a train of metal and painted gears over a machined plate."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Conductor, Diffuse, Material, RoughPlastic, Scene, Spin, Still, Texture, textures
from qsim.scene.props import gear
from qsim.scene.rotation import exponential, pose_matrix
from qsim.scene.shapes import cylinder, moved
from qsim.scenes import common
from qsim.scenes.common import between, sign

MODULE = 0.0042  # m of pitch radius per tooth


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return six to nine gears; neighbours turn in opposite directions at rates inverse to their teeth."""
    rng = np.random.default_rng([seed, 3])
    drive = speed * between(rng, 900, 1500) * sign(rng)  # tooth-radians per second
    plate = textures.levels(textures.speckles(rng, 3000, 768, 0.012) + 0.5 * textures.noise(rng, (768, 768)), 0.1, 0.5)
    bodies = [common.wall(Diffuse(Texture(plate, (3.0, 1.5))), 1.4, 0.7, z=-0.03)]
    for i, (teeth, x, y, phase) in enumerate(train(rng, int(rng.integers(6, 10)))):
        radius = MODULE * teeth * 1.08
        solid = gear(teeth, radius, 0.016, depth=0.20 * 12 / teeth, spokes=int(rng.integers(3, 7)) if teeth > 13 else 0)
        direction = 1.0 if i % 2 == 0 else -1.0
        motion = Still((x, y, 0.0)) @ Spin((0, 0, 1), direction * drive / teeth, phase)
        bodies.append(Body(f"gear {i}", solid, finish(rng), motion))
        axle = moved(cylinder(0.12 * radius, 0.05, 24), pose_matrix(exponential((np.pi / 2, 0, 0)), (x, y, 0.0)))
        bodies.append(Body(f"axle {i}", axle, Conductor(roughness=0.25)))
    tilt = rng.uniform(-0.2, 0.2, 2)
    view = common.camera((tilt[0], tilt[1], 0.62), (0, 0, 0), 0.5)
    return Scene("gears", seed, view, (common.studio(rng), common.lamp(rng, (0, 0, 0), 0.9, 1.5)), tuple(bodies), speed)


def train(rng: np.random.Generator, count: int) -> list[tuple[int, float, float, float]]:
    """Return (teeth, x, y, phase) of gears that mesh in sequence along a crooked line through the view."""
    teeth = [int(n) for n in rng.integers(9, 21, count)]
    places = [np.zeros(2)]
    phases = [0.0]
    heading = between(rng, -0.6, 0.6)
    for i in range(1, count):
        reach = MODULE * (teeth[i - 1] + teeth[i])
        y = places[-1][1]
        heading = float(np.clip(rng.uniform(-1.1, 1.1) - 6 * y, -1.2, 1.2))
        places.append(places[-1] + reach * np.array([np.cos(heading), np.sin(heading)]))
        # A tooth of the last gear points along `heading` when a gap of the next one points back at it
        share = (phases[-1] - heading) * teeth[i - 1]
        phases.append(heading + np.pi + (np.pi - share) / teeth[i])
    middle = np.mean(places, axis=0)
    return [(n, *(place - middle), phase) for n, place, phase in zip(teeth, places, phases, strict=True)]


def finish(rng: np.random.Generator) -> Material:
    """Return steel, brass or paint."""
    kind = int(rng.integers(4))
    if kind == 0:
        return Conductor(roughness=between(rng, 0.2, 0.4))
    if kind == 1:
        return Conductor(0.42, 2.35, between(rng, 0.25, 0.4))
    return RoughPlastic(common.surface(rng, 0.1, 0.8), 0.25)
