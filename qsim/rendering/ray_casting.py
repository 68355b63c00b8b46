"""Casts rays into a loaded scene: distance, body and triangle of the first hit along each.

A ray passes through a surface where that lets more than half of the light straight on: through holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.optics.camera import Camera
from qsim.rendering.mitsuba_scene import Stage
from qsim.scene import Body
from qsim.scene.materials import MetallicRoughness, Texture, see_through

MOST_LAYERS = 32  # of surfaces with holes, one behind the other
GAP = 1e-5  # relative distance behind a hole at which a ray goes on


@dataclass(frozen=True)
class Hits:
    """First surfaces along rays, one entry per ray; all arrays [N] unless stated."""

    distance: Array  # float64, in lengths of the ray (z of the camera's axes where the ray's z is 1); inf: nothing hit
    number: Array  # int32, body number; lamps follow the bodies; -1 for a miss
    triangle: Array  # int64, index into the mesh's faces
    weights: Array  # float64 [N, 2], barycentric weights of the triangle's second and third vertex


@lru_cache(maxsize=2)
def pixel_rays(camera: Camera, crop: tuple[int, int, int, int], thinned: int = 1) -> Array:
    """Return rays [3, N] through a window's pixel centres, row by row, in the camera's axes with z = 1; read-only."""
    y, x, height, width = crop
    rays = camera.directions()[y : y + height : thinned, x : x + width : thinned]
    found = np.ascontiguousarray(rays.reshape(-1, 3).T)
    found.setflags(write=False)
    return found


class RayCaster:
    """First hits in a loaded scene at its current time; the scalar engine casts one ray after the other."""

    def __init__(self, stage: Stage, backend: str) -> None:
        self._mi = stage.mi
        self._stage = stage
        self._scalar = backend == "scalar"
        self._numbers = self._shape_table(stage.shape_numbers(), -1)
        self._first_faces = self._shape_table(stage.first_faces(), 0)

    def cast(self, pose: Array, rays: Array) -> Hits:
        """Return the first hits along rays [3, N] in the axes of a camera with this pose [4, 4]."""
        origin = pose[:3, 3]
        directions = pose[:3, :3] @ rays
        hits = self._first(origin, directions)
        if not self._stage.scene.see_through:
            return hits
        for _ in range(MOST_LAYERS):
            chosen = np.flatnonzero(self._passes(hits))
            if not len(chosen):
                break
            # A little behind the surface that lets light pass, or the ray would meet it again.
            start = hits.distance[chosen] * (1 + GAP)
            moved = origin[:, None] + directions[:, chosen] * start
            behind = self._first(moved, directions[:, chosen])
            hits.distance[chosen] = behind.distance + start
            hits.number[chosen] = behind.number
            hits.triangle[chosen] = behind.triangle
            hits.weights[chosen] = behind.weights
        return hits

    def _passes(self, hits: Hits) -> Array:
        """Return which hits [N] are of a hole."""
        found = np.zeros(len(hits.number), bool)
        for i, body in enumerate(self._stage.scene.bodies):
            if see_through(body.material):
                chosen = np.flatnonzero(hits.number == i)
                found[chosen] = _opacity(body, hits, chosen) < 0.5
        return found

    def _first(self, origin: Array, directions: Array) -> Hits:
        """Return the first hits from one point [3], or from points [3, N], along directions [3, N]."""
        if self._scalar:
            return self._cast_one_by_one(origin, directions)
        import drjit as dr

        mi = self._mi
        direction = mi.Vector3f(directions.astype(np.float32))
        length = dr.norm(direction)
        if origin.ndim == 1:
            eye = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in origin))
        else:
            eye = mi.Point3f(origin.astype(np.float32))
        ray = mi.Ray3f(eye, direction / length)
        found = self._stage.loaded.ray_intersect_preliminary(ray, coherent=True)
        hit = found.is_valid()
        index = _index(mi, found)
        distance = dr.select(hit, found.t / length, dr.inf)
        triangle = dr.select(hit, found.prim_index, 0)
        weights = dr.select(hit, found.prim_uv, 0)
        dr.eval(index, distance, triangle, weights)  # together: separate evaluations would cast the rays again
        shape = np.minimum(np.array(index), len(self._numbers) - 1)
        number = self._numbers[shape]
        far = np.where(number >= 0, np.array(distance, np.float64), np.inf)
        face = np.array(triangle, np.int64) + np.where(number >= 0, self._first_faces[shape], 0)
        return Hits(far, number, face, np.array(weights, np.float64).reshape(2, -1).T)

    def first(self, view: Array, ray: Any) -> tuple[Any, Any]:
        """Return 1 / depth [1/m] along the axis of a camera with this pose [4, 4], and body number + 1, of first hits.

        Dr.Jit arrays, one entry per ray, not evaluated; 0 and 0 where nothing is hit. Not for the scalar engine.
        """
        import drjit as dr

        mi = self._mi
        found = self._stage.loaded.ray_intersect_preliminary(ray, coherent=True)
        numbers = mi.UInt32((self._numbers + 1).astype(np.uint32))
        index = dr.minimum(_index(mi, found), len(self._numbers) - 1)
        body = dr.select(found.is_valid(), dr.gather(mi.UInt32, numbers, index), 0)
        forward = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in view[:3, 2]))
        return dr.select(body > 0, 1 / (found.t * dr.dot(ray.d, forward)), 0), body

    def _cast_one_by_one(self, origin: Array, directions: Array) -> Hits:
        mi = self._mi
        numbers = self._stage.shape_numbers()
        first_faces = self._stage.first_faces()
        lengths = np.linalg.norm(directions, axis=0)
        distance = np.full(len(lengths), np.inf)
        number = np.full(len(lengths), -1, np.int32)
        triangle = np.zeros(len(lengths), np.int64)
        weights = np.zeros((len(lengths), 2))
        origins = np.broadcast_to(origin if origin.ndim > 1 else origin[:, None], directions.shape)
        for i, (direction, length) in enumerate(zip(directions.T, lengths, strict=True)):
            ray = mi.Ray3f(origins[:, i].tolist(), (direction / length).tolist())
            found = self._stage.loaded.ray_intersect_preliminary(ray)
            if found.is_valid():
                name = (found.instance or found.shape).id()
                number[i] = numbers.get(name, -1)
                triangle[i] = found.prim_index + first_faces.get(name, 0)
                weights[i] = found.prim_uv
                distance[i] = found.t / length if number[i] >= 0 else np.inf
        return Hits(distance, number, triangle, weights)

    def _shape_table(self, values: dict[str, int], unknown: int) -> Array:
        """Return the values of shapes, such as body numbers, by Dr.Jit's registry index; unknown ones are the sun."""
        if self._scalar:
            return np.zeros(0, np.int32)
        import drjit as dr

        mi = self._mi
        shapes = self._stage.loaded.shapes()
        pointers: list[Any] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in shapes]
        indices = [int(pointer[0]) for pointer in pointers]
        table = np.full(max([0, *indices]) + 2, unknown, np.int32)
        for index, shape in zip(indices, shapes, strict=True):
            table[index] = values.get(shape.id(), unknown)
        return table


def _index(mi: Any, found: Any) -> Any:
    """Return Dr.Jit's registry index of the instance or shape that each ray meets first; 0 for a miss."""
    import drjit as dr

    shape = dr.reinterpret_array(mi.UInt32, found.shape)
    instance: Any = dr.reinterpret_array(mi.UInt32, found.instance)
    # Dr.Jit leaves misses uninitialised.
    return dr.select(found.is_valid(), dr.select(instance > 0, instance, shape), 0)


def _opacity(body: Body, hits: Hits, chosen: Array) -> Array:
    """Return the opacity [n] of a body at these of the hits."""
    assert isinstance(body.material, MetallicRoughness)
    opacity = body.material.opacity
    if not isinstance(opacity, Texture):
        return np.full(len(chosen), opacity)
    assert body.mesh.uv is not None
    corners = body.mesh.uv[body.mesh.faces[hits.triangle[chosen]]]
    weights = hits.weights[chosen]
    first = 1 - weights.sum(axis=1)
    return opacity.at(np.einsum("nij,ni->nj", corners, np.column_stack([first, weights])))
