"""Makes rotation: a spinning fan in front of a textured wall, with or without a wire guard."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Conductor, Constant, Diffuse, Mesh, RoughPlastic, Scene, Spin, Still
from qsim.scene.props import rotor
from qsim.scene.rotation import exponential, pose_matrix
from qsim.scene.shapes import ball, cylinder, merged, moved, wire
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return a fan with about 5 to 9 turns per second at speed 1."""
    rng = np.random.default_rng([seed, 1])
    radius = between(rng, 0.36, 0.43)
    place = Still((between(rng, -0.06, 0.06), between(rng, -0.03, 0.03), 0.45), common.upright(rng.uniform(-0.5, 0.5)))
    rate = speed * between(rng, 30, 55) * sign(rng)
    spin = place @ Spin((0, 0, 1), rate, phase=any_angle(rng))
    blades = rotor(
        blades=int(rng.integers(3, 7)),
        radius=radius,
        pitch=between(rng, 0.3, 0.7),
        width=between(rng, 0.6, 1.0),
        sweep=between(rng, -0.2, 0.5),
    )
    facing = pose_matrix(exponential((np.pi / 2, 0, 0)))
    behind = pose_matrix(facing[:3, :3], (0, 0, -0.17))
    cap = moved(ball(0.12 * radius, 40), pose_matrix(None, (0, 0, 0.05)))
    hub = merged([moved(cylinder(0.19 * radius, 0.1, 40), facing), cap])
    bodies = [
        common.wall(Diffuse(common.backdrop(rng, 0.06, 0.45)), 4.4, 2.2, z=-0.25),
        Body("blades", blades, common.paint(rng, common.surface(rng, 0.15, 0.9)), spin),
        Body("hub", hub, RoughPlastic(common.surface(rng, 0.1, 0.6), 0.2), spin),
        Body("motor", moved(cylinder(0.24 * radius, 0.2, 40), behind), Conductor(roughness=0.35), place),
    ]
    if rng.random() < 0.5:
        bodies.append(Body("guard", guard(1.08 * radius, int(rng.integers(3, 6))), Conductor(roughness=0.3), place))
    lights = (Constant(between(rng, 0.3, 0.7)), common.lamp(rng, (0, 0, 0.3)))
    view = common.camera((between(rng, -0.3, 0.3), between(rng, -0.2, 0.25), 2.6), (0, 0, 0.3), 0.45)
    return Scene("fan", seed, view, lights, tuple(bodies), speed)


def guard(radius: float, rings: int) -> Mesh:
    """Return rings and spokes of wire in front of the blades."""
    a = np.linspace(0, 2 * np.pi, 73)[:-1]
    wires = []
    for r in np.linspace(0.3, 1.0, rings):
        z = 0.14 - 0.08 * r**2
        wires.append(
            wire(np.stack([r * radius * np.cos(a), r * radius * np.sin(a), np.full_like(a, z)], 1), 0.004, 6, True)
        )
    r = np.linspace(0.1, 1.0, 12)
    for angle in np.linspace(0, 2 * np.pi, 13)[:-1]:
        path = np.stack([r * radius * np.cos(angle), r * radius * np.sin(angle), 0.14 - 0.08 * r**2], 1)
        wires.append(wire(path, 0.003, 6))
    return merged(wires)
