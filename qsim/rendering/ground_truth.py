"""Computes ground truth from known motion: flow, validity, depth and body of the point behind each pixel centre.

    hits at time t + poses -> flow to t' [px], validity, depth [m], body number

Each hit belongs to a body. The body's poses (or its deformed triangle) carry the point to another time, and the
camera's pose of that time projects it. Nothing is estimated from images. Points of the surroundings are infinitely
distant and move only with the camera's rotation. For glass and mirrors, the flow is that of the surface. A thin lens
has the truth of a pinhole in its middle; distortion bends rays and flow alike.

A point is a ray [3, N] in the camera's axes and a distance d in lengths of that ray. A rigid motion (R, T) maps the ray
r to R r + T / d and keeps d. Nearby points and those at infinity (d = inf) therefore follow one rule, and points at
rest keep their rays to the last bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy import ndarray as Array

from qsim.optics.camera import Camera
from qsim.rendering.ray_casting import Hits
from qsim.scene import Body, Scene

SPEED_STEPS = 64  # of an exposure; a speed is measured over one step, so up to 32 turns are distinguished from rest
SPEED_PARTS = (
    -0.5,
    -0.27,
    0.0,
    0.23,
    0.5,
)  # fractions of the exposure; uneven, so that no oscillation rests at all of them
OCCLUSION_TOLERANCE = 1e-4  # relative distance by which a point may lie behind its own surface


def flow_between(scene: Scene, rays: Array, hits: Hits, t: float, later: float) -> tuple[Array, Array, Array]:
    """Return flow [2, N] in px from time t to `later` [s], whether it ends inside the frame [N], and the later rays.

    `rays` [3, N] are those of the hits at time t. The later rays [3, N] are in the later camera's axes, with the
    points at `hits.distance` lengths. For a point behind the later camera, flow is 0 and not inside.
    """
    before = scene.camera.at(t)
    camera = scene.camera.at(later)
    start, end, moved = seen_again(scene, rays, hits, t, later)
    if moved is not None and before is camera:
        # Points at rest stay inside the frame, and their flow is exactly 0.
        flow = np.zeros((2, rays.shape[1]))
        inside = np.ones(rays.shape[1], bool)
        flow[:, moved], inside[moved] = _flow(before, camera, start[:, moved], end[:, moved])
        return flow, inside, end
    return *_flow(before, camera, start, end), end


def _flow(before: Camera, camera: Camera, start: Array, end: Array) -> tuple[Array, Array]:
    """Return flow [2, N] and whether it ends inside the frame [N], from rays [3, N] of two cameras to one point."""
    ahead = end[2] > 0
    place = camera.seen(end[:2] / np.where(ahead, end[2], 1.0))
    inside = ahead
    for along, axis, size in zip(place, camera.axis, (camera.width, camera.height), strict=True):
        low, high = (edge / camera.focal_pixels for edge in (axis, size - axis))
        inside = inside & (along >= -low) & (along <= high)
    # Of a resting lens both ends have one scale, and a point at rest has a flow of exactly 0.
    if before is camera:
        return np.where(ahead, place - camera.seen(start[:2] / start[2]), 0.0) * camera.focal_pixels, inside
    ends = [
        view.seen(slopes) * view.focal_pixels + np.array(view.axis)[:, None]
        for view, slopes in ((before, start[:2] / start[2]), (camera, end[:2] / np.where(ahead, end[2], 1.0)))
    ]
    return np.where(ahead, ends[1] - ends[0], 0.0), inside


def motion_extent(scene: Scene, rays: Array, hits: Hits, t: float, exposure: float, *, sharp: bool) -> Array:
    """Return the image-space motion [px] of each hit during an exposure [s] around time t [s], float64 [N].

    It follows from the largest speed, not from the end points: a wheel that turns once has moved. `sharp` uses the
    speed at t alone.
    """
    parts = (0.0,) if sharp else SPEED_PARTS
    fastest = np.zeros(rays.shape[1])
    step = exposure / SPEED_STEPS
    for part in parts:
        ends = [t + part * exposure + step / 2, t + part * exposure - step / 2]
        late, early = (flow_between(scene, rays, hits, t, end)[0] for end in ends)
        fastest = np.maximum(fastest, np.hypot(*(late - early)))
    across = math.hypot(scene.camera.height, scene.camera.width)  # no point moves farther in the frame
    return np.minimum(fastest * SPEED_STEPS, across)


def seen_again(scene: Scene, rays: Array, hits: Hits, t: float, later: float) -> tuple[Array, Array, Array | None]:
    """Return the rays [3, N] of the hits at time t, of the same points at time `later`, and the points that moved.

    The first result differs from `rays` only for deforming bodies: their points are rebuilt from their triangles, with
    the same rounding at both times. Points that moved are sorted indices [n]; None where the camera moved.
    """
    before = scene.camera.pose(t)
    after = scene.camera.pose(later)
    inverse = 1 / hits.distance
    start = rays
    end = _moved(rays, inverse, before, np.eye(4), after)
    moved = []
    for number in np.flatnonzero(np.bincount(hits.number + 1)[1:]).tolist():
        body = scene.bodies[number] if number < len(scene.bodies) else None
        if body is not None and body.deforms:
            chosen = np.flatnonzero(hits.number == number)
            moved.append(chosen)
            start = start.copy() if start is rays else start
            for ends, moment, view in ((start, t, before), (end, later, after)):
                points = _points(body, hits, chosen, moment) - view[:3, 3]
                ends[:, chosen] = view[:3, :3].T @ points.T * inverse[chosen]
            continue
        here = body_pose(scene, number, t)
        there = body_pose(scene, number, later)
        if not np.array_equal(here, there):
            chosen = np.flatnonzero(hits.number == number)
            moved.append(chosen)
            motion = there @ np.linalg.inv(here)
            end[:, chosen] = _moved(rays[:, chosen], inverse[chosen], before, motion, after)
    if not np.array_equal(before, after):
        return start, end, None
    return start, end, np.sort(np.concatenate(moved)) if moved else np.zeros(0, np.int64)


def visible(distance: Array, hits: Hits) -> Array:
    """Return whether points at `distance` [N] are the first surfaces along the rays of `hits`; inf the background."""
    return hits.distance >= distance * (1 - OCCLUSION_TOLERANCE)


def _moved(rays: Array, inverse: Array, before: Array, motion: Array, after: Array) -> Array:
    """Return rays [3, N] from camera pose `after`, for points at 1 / `inverse` [N] of `before` moved by `motion`."""
    if np.array_equal(motion @ before, after):
        return rays.copy()
    # Points are (x / z, y / z, 1) z. Divided by z, a far background stays finite: its translation counts 1 / inf = 0.
    whole = np.linalg.inv(after) @ motion @ before
    return whole[:3, :3] @ rays + whole[:3, 3:] * inverse


def body_pose(scene: Scene, number: int, t: float) -> Array:
    """Return the body-to-world matrix [4, 4] at time t [s] of a body, lamp or part, by its number in ground truth."""
    motion = getattr((*scene.bodies, *scene.lights, *scene.parts)[number], "motion", None)
    return np.eye(4) if motion is None else np.asarray(motion.pose(t), np.float64)


def _points(body: Body, hits: Hits, chosen: Array, t: float) -> Array:
    """Return world points [n, 3] of the chosen hits at time t [s], rebuilt from their triangles."""
    corners = body.vertices(t)[body.mesh.faces[hits.triangle[chosen]]]
    weights = hits.weights[chosen]
    pose = body.pose(t)
    # Barycentric coordinates: the third weight is what the other two leave.
    first = 1 - weights.sum(axis=1)
    return np.einsum("nij,ni->nj", corners, np.column_stack([first, weights])) @ pose[:3, :3].T + pose[:3, 3]
