"""Deforms meshes by joints and morph targets: linear blend skinning, in closed form at any time.

    vertex(t) = sum over its joints of share * joint matrix(t) * (rest + sum of morph weight(t) * displacement)

The matrix of a joint is that of its parent times its own motion, from rest to time t, in the coordinates of the body.
A joint may have any motion of `qsim.scene`: a `Pendulum` about the hip swings a leg, and the knee below it follows.
Left out: dual quaternions, volume preservation, contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from qsim.checks import require_finite
from qsim.scene.animated.tracks import Clock, Track
from qsim.scene.motion import Motion, Still
from qsim.scene.rotation import Array

LARGEST = 1e6  # m; positions beyond are those of damaged files, and single precision ends there
ROUNDING = 1e-6  # by which the shares of a vertex may differ from 1


class Placed(Protocol):
    """Anything with a pose: every motion of `qsim.scene`, keys of a file, a matrix."""

    def pose(self, t: float) -> Array:
        """Return the matrix at time t [s], float64 [4, 4]."""


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint: its motion in the coordinates of its parent; a parent of -1 is the body itself."""

    motion: Placed
    parent: int = -1


@dataclass(frozen=True, eq=False)
class Morph:
    """Morph targets of consecutive vertices: displacements, each times a weight that may change over time."""

    first: int  # vertex
    displacements: Array  # m, [M, v, 3]
    weights: Track  # [K, M]


@dataclass(frozen=True, eq=False)
class Skinned(Motion):
    """The motion of a body whose vertices follow joints.

    `ValueError` for a joint before its parent, for joints that do not exist, and for shares that do not sum to 1.
    """

    rest: Array  # m, vertices [V, 3] before all joints
    joints: tuple[Joint, ...]  # parents first
    owners: Array  # int [V, n], joints of each vertex
    shares: Array  # [V, n], how much of each joint's motion a vertex takes; they sum to 1
    morphs: tuple[Morph, ...] = ()
    clock: Clock = field(default_factory=Clock)  # of joints and morph weights
    carrier: Motion = field(default_factory=Still)  # of the complete body

    def __post_init__(self) -> None:
        rest = np.asarray(self.rest, np.float64)
        if rest.ndim != 2 or rest.shape[1] != 3 or not len(rest):
            raise ValueError(f"Skinned.rest: vertices [V, 3] are needed, got {rest.shape}")
        for i, joint in enumerate(self.joints):
            if not -1 <= joint.parent < i:
                raise ValueError(f"Skinned.joints[{i}]: its parent must come before it, got {joint.parent}")
        shares = check_shares("Skinned", self.owners, self.shares, len(rest), len(self.joints), ROUNDING)
        for morph in self.morphs:
            count = np.shape(morph.displacements)[1]
            targets = np.shape(morph.displacements)[0]
            if not 0 <= morph.first <= len(rest) - count or targets != morph.weights.values.shape[1]:
                raise ValueError(
                    f"Skinned.morphs: displacements [M, v, 3] of existing vertices with M weights are needed, "
                    f"got {np.shape(morph.displacements)} from vertex {morph.first} and {morph.weights.values.shape[1]}"
                )
        object.__setattr__(self, "rest", rest)
        object.__setattr__(self, "owners", np.asarray(self.owners, np.int32))
        object.__setattr__(self, "shares", shares)

    def pose(self, t: float) -> Array:
        return self.carrier.pose(t)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return self.carrier.velocity(t)

    def matrices(self, moment: float) -> Array:
        """Return the matrix of every joint, from rest to a time [s] of the animation, float64 [joints, 4, 4]."""
        found: list[Array] = []
        for joint in self.joints:
            # A parent comes before its children in the list, so that its matrix is known here.
            own = np.asarray(joint.motion.pose(moment), np.float64)
            found.append(own if joint.parent < 0 else found[joint.parent] @ own)
        return np.array(found)

    def deform(self, t: float) -> Array:
        """Return vertices [m] in body coordinates at time t [s], float64 [V, 3].

        `ValueError` for vertices that are more than 1e6 m away.
        """
        moment = self.clock.at(t)
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            matrices = self.matrices(moment)
            shape = self._morphed(moment)
            moved = np.zeros_like(shape)
            # Linear blend skinning (glTF 2.0, 3.7.3.3): each vertex is the mean of where its joints would put it.
            for owners, shares in zip(self.owners.T, self.shares.T, strict=True):
                chosen = matrices[owners]
                moved += shares[:, None] * (np.einsum("vij,vj->vi", chosen[:, :3, :3], shape) + chosen[:, :3, 3])
        if not np.abs(moved).max() <= LARGEST:
            raise ValueError(f"a skinned body has vertices farther away than {LARGEST:g} m at {moment:g} s")
        return moved

    def _morphed(self, moment: float) -> Array:
        if not self.morphs:
            return self.rest
        shape = self.rest.copy()
        for morph in self.morphs:
            shift = np.einsum("m,mvi->vi", morph.weights.at(moment), morph.displacements)
            shape[morph.first : morph.first + len(shift)] += shift
        return shape


def check_shares(where: str, owners: Array, shares: Array, vertices: int, joints: int, tolerance: float) -> Array:
    """Return the shares [V, n], float64, scaled to sum to 1; `ValueError` names the first wrong vertex."""
    owners = np.asarray(owners)
    shares = np.asarray(shares, np.float64)
    if owners.ndim != 2 or owners.shape != shares.shape or len(owners) != vertices:
        raise ValueError(
            f"{where}: joints and weights of shape [{vertices}, n] are needed, one row per vertex, "
            f"got {owners.shape} and {shares.shape}"
        )
    require_finite(f"{where}: weights", shares)
    outside = ((owners < 0) | (owners >= joints)).any(axis=1)
    if outside.any():
        vertex = int(np.argmax(outside))
        raise ValueError(
            f"{where}: vertex {vertex} has the joints {owners[vertex].tolist()}; there are {joints}, from 0"
        )
    total = shares.sum(axis=1)
    wrong = (shares < 0).any(axis=1) | (np.abs(total - 1) > tolerance)
    if wrong.any():
        vertex = int(np.argmax(wrong))
        raise ValueError(
            f"{where}: the weights of vertex {vertex} are {np.round(shares[vertex], 4).tolist()}; "
            "they must be 0 or more and sum to 1"
        )
    return shares / total[:, None]
