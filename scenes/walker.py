"""Makes skinned bodies: an animal of four or six legs walks over a textured floor, with a swinging tail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qsim.scene import (
    Body,
    Clock,
    Diffuse,
    Joint,
    Mesh,
    Motion,
    Oscillation,
    Pendulum,
    Scene,
    Skinned,
    Still,
    Translation,
)
from qsim.scene.rotation import exponential, pose_matrix
from qsim.scene.shapes import ball, merged, moved, revolved
from qsim.scenes import common
from qsim.scenes.common import any_angle, between, pick

Array = NDArray[np.float64]
# m: half axes, length and radius of a leg
TRUNK = (0.075, 0.032, 0.036)
LEG = 0.1
THICK = 0.013
FLOOR = -LEG - 0.5 * TRUNK[1]  # m; the trunk is at 0
# m
TAIL = 0.13
TAIL_JOINTS = 5


def scene(seed: int = 0, *, speed: float = 1.0) -> Scene:
    """Return a walker of 30 cm that moves at 1.2 to 2 m/s and takes 9 to 13 steps per second at speed 1."""
    rng = np.random.default_rng([seed, 18])
    bodies = [
        common.floor(Diffuse(common.backdrop(rng)), 2.4, y=FLOOR, z=-0.2),
        common.wall(Diffuse(common.backdrop(rng)), 2.4, 1.2, z=-0.6, y=0.35),
    ]
    yaw = between(rng, -0.5, 0.5) + pick(rng, (0.0, np.pi))
    rate = between(rng, 1.2, 2.0) * speed
    velocity = rate * exponential(common.upright(yaw))[:, 0]
    way = Translation(tuple(velocity), tuple(-velocity * common.CLIP / 2))
    mesh, motion = jointed(rng, speed, way @ Still((0.0, 0.0, 0.0), common.upright(yaw)))
    bodies.append(Body("walker", mesh, common.paint(rng, common.surface(rng, 0.1, 0.9)), motion))
    view = common.camera((between(rng, -0.08, 0.08), between(rng, 0.02, 0.12), 0.65), (0, 0, 0), 0.5)
    return Scene("walker", seed, view, (common.sun(rng),), tuple(bodies), speed)


@dataclass
class _Parts:
    """Meshes and joints of a body that is being built."""

    meshes: list[Mesh] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    owners: list[Array] = field(default_factory=list)  # [V, 3] each
    shares: list[Array] = field(default_factory=list)

    def joint(self, motion: Motion, parent: int = -1) -> int:
        self.joints.append(Joint(motion, parent))
        return len(self.joints) - 1

    def add(self, mesh: Mesh, owners: Array, shares: Array) -> None:
        count = len(mesh.vertices)
        self.meshes.append(mesh)
        self.owners.append(np.broadcast_to(owners, (count, 3)))
        self.shares.append(np.broadcast_to(shares, (count, 3)))


def jointed(rng: np.random.Generator, speed: float, carrier: Motion) -> tuple[Mesh, Skinned]:
    """Return the mesh of a walker that looks along +x, and its motion; every random number is drawn at any speed."""
    frequency = between(rng, 9, 13)
    phase = any_angle(rng)
    pairs = int(rng.integers(2, 4))
    parts = _Parts()
    trunk = parts.joint(Oscillation((0.0, 0.004, 0.0), 2 * frequency, phase))
    parts.add(moved(ball(1.0, 40), pose_matrix(np.diag(TRUNK))), np.full(3, trunk), np.array([1.0, 0, 0]))
    head = parts.joint(Pendulum((0.06, 0.01, 0.0), (0, 0, 1), between(rng, 0.1, 0.3), frequency, phase), trunk)
    skull = moved(ball(0.025, 32), pose_matrix(np.diag([1.3, 1, 1]), (0.084, 0.022, 0)))
    parts.add(skull, np.full(3, head), np.array([1.0, 0, 0]))
    swing = between(rng, 0.45, 0.7)
    bend = between(rng, 0.3, 0.6)
    for i, x in enumerate(np.linspace(0.045, -0.045, pairs)):
        for k, z in enumerate((-0.026, 0.026)):
            _leg(parts, trunk, (float(x), -0.012, z), frequency, phase + np.pi * (i + k), swing, bend)
    _tail(parts, trunk, frequency / 2, any_angle(rng), between(rng, 0.15, 0.3))
    mesh = merged(parts.meshes)
    owners = np.concatenate(parts.owners)
    shares = np.concatenate(parts.shares)
    clock = Clock(speed)
    return mesh, Skinned(mesh.vertices, tuple(parts.joints), owners, shares, clock=clock, carrier=carrier)


def _leg(
    parts: _Parts,
    trunk: int,
    hip: tuple[float, float, float],
    frequency: float,
    phase: float,
    swing: float,
    bend: float,
) -> None:
    """Add a leg that hangs from the hip; its skin is blended at hip and knee."""
    knee = (hip[0], hip[1] - LEG / 2, hip[2])
    upper = parts.joint(Pendulum(hip, (0, 0, 1), swing, frequency, phase), trunk)
    lower = parts.joint(Pendulum(knee, (0, 0, 1), bend, frequency, phase - np.pi / 2), upper)
    y = np.linspace(-1, 0, 21)
    outline = THICK * (0.6 + 0.4 * (1 + y)) * np.sqrt(np.clip(1 - (2 * y + 1) ** 12, 0, 1))
    mesh = moved(revolved(list(zip(outline.tolist(), (LEG * y).tolist(), strict=True)), 20), pose_matrix(None, hip))
    down = (hip[1] - mesh.vertices[:, 1]) / LEG  # 0 at the hip, 1 at the foot
    at_hip = 1 - _smooth(down / 0.15)
    at_knee = _smooth((down - 0.4) / 0.2)
    shares = np.stack([at_hip, (1 - at_hip) * (1 - at_knee), (1 - at_hip) * at_knee], 1)
    parts.add(mesh, np.array([trunk, upper, lower]), shares)


def _tail(parts: _Parts, trunk: int, frequency: float, phase: float, swing: float) -> None:
    """Add a tail along -x: a chain of joints that swing sideways one after the other."""
    start = -0.8 * TRUNK[0]
    chain = [trunk]
    for i in range(TAIL_JOINTS):
        place = (start - TAIL * i / TAIL_JOINTS, 0.0, 0.0)
        chain.append(parts.joint(Pendulum(place, (0, 1, 0), swing, frequency, phase - 0.7 * i), chain[-1]))
    s = np.linspace(0, 1, 41)
    outline = 0.016 * (1 - 0.8 * s) * np.sqrt(np.clip(1 - (2 * s - 1) ** 16, 0, 1))
    upright = revolved(list(zip(outline.tolist(), (TAIL * s).tolist(), strict=True)), 20)
    mesh = moved(upright, pose_matrix(exponential((0, 0, np.pi / 2)), (start, 0, 0)))  # from +y to -x
    along = np.clip((start - mesh.vertices[:, 0]) / TAIL, 0, 1) * (TAIL_JOINTS - 1)
    first = np.minimum(along.astype(int), TAIL_JOINTS - 2)
    numbers = np.array(chain[1:])
    owners = np.stack([numbers[first], numbers[first + 1], numbers[first]], 1)
    parts.add(mesh, owners, np.stack([1 - (along - first), along - first, 0 * along], 1))


def _smooth(x: Sequence[float] | Array) -> Array:
    """Return a step from 0 to 1 between x = 0 and 1 without kinks."""
    inside = np.clip(x, 0, 1)
    return inside * inside * (3 - 2 * inside)
