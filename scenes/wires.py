"""Makes thin structures: spoked wheels, springs and wire globes, one to three pixels thick."""

from __future__ import annotations

import numpy as np

from qsim.scene import Body, Conductor, Diffuse, Material, Mesh, Motion, Oscillation, RoughPlastic, Scene, Spin, Still
from qsim.scene.props import spring
from qsim.scene.rotation import exponential, pose_matrix, vector
from qsim.scene.shapes import merged, moved, torus, wire
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick, sign


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return a central wheel with globes and springs beside it, at 3 to 8 turns a second at speed 1."""
    rng = np.random.default_rng([seed, 6])
    bodies = [common.wall(Diffuse(common.backdrop(rng, 0.15, 0.7)), 1.5, 0.75, z=-0.2)]
    places = [(0.0, 0.0), (-0.21, 0.03), (0.21, -0.02), (-0.33, -0.06), (0.33, 0.06)]
    for i, (x, y) in enumerate(places):
        place = Still(
            (x + between(rng, -0.02, 0.02), y + between(rng, -0.02, 0.02), 0.0),
            vector(rng.normal(0, 0.3, 3)),
        )
        rate = speed * between(rng, 25, 50) * sign(rng)
        kind = pick(rng, ("wheel", "globe", "cage")) if i < 3 else "spring"
        size = 0.12 if i == 0 else between(rng, 0.07, 0.085)
        motion: Motion = place @ Spin(AXES[kind], rate, any_angle(rng))
        if kind == "spring":
            motion = Oscillation((0.0, 0.03, 0.0), speed * between(rng, 10, 20), any_angle(rng)) @ motion
        bodies.append(Body(f"{kind} {i}", MAKERS[kind](rng, size), metal(rng), motion))
    view = common.camera((between(rng, -0.1, 0.1), between(rng, -0.05, 0.1), 0.65), (0, 0, 0), 0.45)
    return Scene("wires", seed, view, (common.studio(rng), common.lamp(rng, (0, 0, 0), 0.9, 1.8)), tuple(bodies), speed)


def wheel(rng: np.random.Generator, radius: float) -> Mesh:
    """Return a rim with crossed spokes to a hub, around z."""
    rim = moved(torus(radius, 0.04 * radius), pose_matrix(exponential((np.pi / 2, 0, 0))))
    hub = moved(torus(0.1 * radius, 0.04 * radius, 24), pose_matrix(exponential((np.pi / 2, 0, 0))))
    spokes = 2 * int(rng.integers(6, 13))
    cross = between(rng, 0, 0.8)
    thickness = between(rng, 0.0005, 0.0012)
    rods = []
    for k in range(spokes):
        a = 2 * np.pi * k / spokes
        b = a + cross * (-1) ** k
        z = 0.06 * radius * (-1) ** k
        ends = [
            0.1 * radius * np.array([np.cos(b), np.sin(b), 0]) + (0, 0, z),
            radius * np.array([np.cos(a), np.sin(a), 0]),
        ]
        rods.append(wire(ends, thickness, 6))
    return merged([rim, hub, *rods])


def globe(rng: np.random.Generator, radius: float) -> Mesh:
    """Return meridians and parallels of wire, axis y."""
    a = np.linspace(0, 2 * np.pi, 61)[:-1]
    thickness = between(rng, 0.0005, 0.0013)
    circle = np.stack([np.cos(a), np.sin(a), 0 * a], 1) * radius
    meridians = [
        moved(wire(circle, thickness, 6, closed=True), pose_matrix(exponential((0, turn, 0))))
        for turn in np.linspace(0, np.pi, int(rng.integers(4, 9)) + 1)[:-1]
    ]
    parallels = []
    for latitude in np.linspace(-1.1, 1.1, int(rng.integers(3, 7))):
        ring = (
            np.stack([np.cos(latitude) * np.cos(a), 0 * a + np.sin(latitude), np.cos(latitude) * np.sin(a)], 1) * radius
        )
        parallels.append(wire(ring, thickness, 6, closed=True))
    return merged(meridians + parallels)


def cage(rng: np.random.Generator, radius: float) -> Mesh:
    """Return a tangle: one closed wire along a random torus-knot-like path."""
    p, q = pick(rng, ((2, 3), (3, 4), (3, 5), (2, 5), (4, 5)))
    a = np.linspace(0, 2 * np.pi, 301)[:-1]
    r = 0.68 + 0.3 * np.cos(q * a)
    path = radius * np.stack([r * np.cos(p * a), 0.6 * np.sin(q * a), r * np.sin(p * a)], 1)
    return wire(path, between(rng, 0.0012, 0.003), 8, closed=True)


def coil(rng: np.random.Generator, size: float) -> Mesh:
    """Return a spring."""
    return spring(0.35 * size, 2.2 * size, float(rng.integers(6, 12)), between(rng, 0.0008, 0.002))


def metal(rng: np.random.Generator) -> Material:
    """Return bright metal, or dark or white paint."""
    kind = int(rng.integers(3))
    if kind == 0:
        return Conductor(roughness=0.3)
    return RoughPlastic((0.03, 0.85)[kind - 1], 0.2)


AXES = {"wheel": (0.0, 0.0, 1.0), "globe": (0.0, 1.0, 0.0), "cage": (0.0, 1.0, 0.0), "spring": (0.0, 1.0, 0.0)}
MAKERS = {"wheel": wheel, "globe": globe, "cage": cage, "spring": coil}
