"""Ground truth from known motion: where the point behind each pixel centre was, is and will be.

    hits at time t + poses -> flow to t' [px], validity, depth [m], body number

A hit belongs to a body; the body's poses (or its deformed triangle) carry it to any other time, the camera's pose of
that time projects it. Nothing is estimated from images. Points of the surroundings lie infinitely far away and move
with the camera's turn only. Through glass and in mirrors the surface itself is followed, not what is seen in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.scene import Camera, Scene

OCCLUSION_TOLERANCE = 1e-4  # relative distance by which a surface may lie before the point that it is itself


@dataclass(frozen=True)
class Hits:
    """First surfaces along rays, one entry per ray [N]."""

    distance: Array  # float64, m along the unit ray; inf where nothing is
    number: Array  # int32, body number; lamps follow the bodies; -1 where nothing is
    triangle: Array  # int64, index into the mesh's faces
    weights: Array  # float64 [N, 2], barycentric weights of the triangle's second and third vertex


def pixel_rays(camera: Camera, t: float, crop: tuple[int, int, int, int], thinned: int = 1) -> tuple[Array, Array]:
    """Camera position [3] and world ray directions [h, w, 3] with unit z in camera axes, through pixel centres."""
    pose = camera.pose(t)
    y, x, height, width = crop
    local = camera.directions()[y : y + height : thinned, x : x + width : thinned]
    return pose[:3, 3], local @ pose[:3, :3].T


def carried(scene: Scene, points: Array, hits: Hits, t: float, later: float) -> tuple[Array, Array]:
    """World points [N, 3] of the hits at time t and where their bodies carry them at time `later`.

    The first answer differs from `points` only for deforming bodies, whose points are rebuilt from their triangles so
    that both times round alike.
    """
    now, then = points.copy(), points.copy()
    for number in np.unique(hits.number[hits.number >= 0]):
        chosen = hits.number == number
        if number < len(scene.bodies) and scene.bodies[number].deforms:
            body = scene.bodies[number]
            corners, weights = body.mesh.faces[hits.triangle[chosen]], hits.weights[chosen]
            now[chosen] = _transformed(body.pose(t), _interpolated(body.vertices(t)[corners], weights))
            then[chosen] = _transformed(body.pose(later), _interpolated(body.vertices(later)[corners], weights))
        else:
            before, after = _pose(scene, number, t), _pose(scene, number, later)
            if not np.array_equal(before, after):
                then[chosen] = _transformed(after @ np.linalg.inv(before), points[chosen])
    return now, then


def flow_between(
    scene: Scene, rays: tuple[Array, Array], hits: Hits, t: float, later: float
) -> tuple[Array, Array, Array]:
    """Flow [2, N] in pixels from time t to `later`, whether it ends inside the frame [N], and the points then [N, 3].

    Where the point is behind the camera then, flow is 0 and not inside. For the surroundings, `points` are directions.
    """
    camera = scene.camera
    origin, directions = rays
    directions = directions.reshape(-1, 3)
    seen = hits.number >= 0
    length = np.linalg.norm(directions, axis=1)
    points = origin + directions * np.where(seen, hits.distance / length, 0.0)[:, None]
    now, then = carried(scene, points, hits, t, later)
    start, _ = _project(camera, now, directions, seen, t)
    end, depth = _project(camera, then, directions, seen, later)
    ahead = depth > 0
    inside = ahead & (end[:, 0] >= 0) & (end[:, 0] <= camera.width) & (end[:, 1] >= 0) & (end[:, 1] <= camera.height)
    flow = np.where(ahead[:, None], end - start, 0.0)
    return flow.T, inside, np.where(seen[:, None], then, directions)


def visible(distance: Array, seen: Array, hits: Hits) -> Array:
    """Whether points at `distance` [N] (surroundings where not `seen`) are the first thing along rays cast to them."""
    reach = np.where(seen, distance * (1 - OCCLUSION_TOLERANCE), np.inf)
    return hits.distance >= reach


def _project(camera: Camera, points: Array, directions: Array, seen: Array, t: float) -> tuple[Array, Array]:
    """Pixels [N, 2] and depth [N]; the surroundings are projected as points at infinity."""
    origin = camera.pose(t)[:3, 3]
    return camera.project(np.where(seen[:, None], points, origin + directions), t)


def _pose(scene: Scene, number: int, t: float) -> Array:
    motion = getattr((*scene.bodies, *scene.lights, *scene.parts)[number], "motion", None)
    return np.eye(4) if motion is None else np.asarray(motion.pose(t), np.float64)


def _transformed(pose: Array, points: Array) -> Array:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _interpolated(corners: Array, weights: Array) -> Array:
    """Points [N, 3] in triangles [N, 3, 3]."""
    first = 1 - weights.sum(axis=1)
    return np.einsum("nij,ni->nj", corners, np.column_stack([first, weights]))
