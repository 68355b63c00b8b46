"""Measures of meshes and outlines: area, volume, and the share of a polygon in its circle."""

from __future__ import annotations

import numpy as np

from qsim.scene import Mesh


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


def area_vectors(mesh: Mesh) -> np.ndarray:
    c = corners(mesh)
    return np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) / 2


def area(mesh: Mesh) -> float:
    return float(np.linalg.norm(area_vectors(mesh), axis=1).sum())


def volume(mesh: Mesh) -> float:
    """Divergence theorem: positive where faces look outward."""
    return float(np.einsum("fi,fi->", corners(mesh).mean(1), area_vectors(mesh)) / 3)


def shoelace(loop: np.ndarray) -> float:
    return abs(float(np.sum(loop[:, 0] * np.roll(loop[:, 1], -1) - loop[:, 1] * np.roll(loop[:, 0], -1)))) / 2


def polygon_share(segments: int) -> float:
    """Area of a regular polygon over that of its circle."""
    return float(np.sin(2 * np.pi / segments) * segments / (2 * np.pi))
