"""The rigid motion of a node in a hierarchy of placements, as of a body, lamp or camera of a glTF file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from qsim.scene.animated.skinning import Placed
from qsim.scene.animated.tracks import Clock
from qsim.scene.motion import Motion
from qsim.scene.rotation import Array, logarithm

STEP = 1e-6  # s, half of the time over which a velocity is measured; its error is 1e-9 of positions of 1 m


def placement(chain: Sequence[Placed], moment: float) -> Array:
    """Return the matrix of the innermost node at a time [s] of the animation, float64 [4, 4]; it may scale."""
    matrix = np.eye(4)
    for each in chain:
        matrix = matrix @ np.asarray(each.pose(moment), np.float64)
    return matrix


def rigid_part(matrix: Array) -> Array:
    """Return a placement with the nearest rotation, or reflection, for its linear part: its polar decomposition."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    found = np.array(matrix, np.float64)
    found[:3, :3] = left @ right
    return found


def inverse(matrix: Array) -> Array:
    """Return the inverse of a placement, float64 [4, 4]."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


@dataclass(frozen=True, eq=False)
class Attached(Motion):
    """The rigid part of the placement of a node: `before @ placement @ after`."""

    chain: tuple[Placed, ...]  # outermost first
    clock: Clock
    before: Array = field(default_factory=lambda: np.eye(4))  # [4, 4]
    after: Array = field(default_factory=lambda: np.eye(4))  # [4, 4]

    def __post_init__(self) -> None:
        for name in ("before", "after"):
            if np.shape(getattr(self, name)) != (4, 4):
                raise ValueError(f"Attached.{name}: a matrix [4, 4] is needed")

    def pose(self, t: float) -> Array:
        return np.asarray(self.before @ rigid_part(placement(self.chain, self.clock.at(t))) @ self.after)

    def velocity(self, t: float) -> tuple[Array, Array]:
        early = self.pose(t - STEP)
        late = self.pose(t + STEP)
        turn = logarithm(late[:3, :3] @ early[:3, :3].T)
        return (late[:3, 3] - early[:3, 3]) / (2 * STEP), turn / (2 * STEP)
