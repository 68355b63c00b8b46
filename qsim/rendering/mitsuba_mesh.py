"""Builds Mitsuba meshes, names their parameters, and computes vertex normals that repeat exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.rendering.engine import errors_only
from qsim.scene import Mesh

# The only names of a mesh's parameters in this project; Mitsuba 3.10 renames them.
POSITIONS = "vertex_positions"
NORMALS = "vertex_normals"
TEXCOORDS = "vertex_texcoords"
COLOURS = "vertex_color"  # an attribute, which Mitsuba wants to begin with vertex_
FACES = "faces"


def mesh_shape(
    mi: Any,
    mesh: Mesh,
    name: str,
    vertices: Array,
    properties: Any,
    faces: range | None = None,
    colours: Array | None = None,
) -> Any:
    """Return a Mitsuba mesh with these vertices [V, 3] in m, of all or some faces; `properties` holds its bsdf.

    `colours` [V, 1 or 3] of the vertices become the attribute COLOURS.
    """
    used = vertices_of(mesh, faces)
    shown = mesh.faces
    uv = mesh.uv
    if faces is not None:
        shown = np.searchsorted(used, mesh.faces[faces.start : faces.stop])
        uv = None if uv is None else uv[used]
    properties["face_normals"] = not mesh.smooth
    shape = mi.Mesh(
        name,
        len(vertices[used]),
        len(shown),
        has_vertex_normals=mesh.smooth,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    shape.set_id(name)
    if colours is not None:
        shape.add_attribute(COLOURS, colours.shape[1], colours[used].astype(np.float32).ravel())
    parameters = mi.traverse(shape)
    parameters[POSITIONS] = vertices[used].astype(np.float32).ravel()
    parameters[FACES] = shown.astype(np.uint32).ravel()
    if uv is not None:
        parameters[TEXCOORDS] = uv.astype(np.float32).ravel()
    with errors_only(mi):  # as in `place`
        parameters.update()
    if mesh.smooth:
        # Mitsuba sums normals over faces in parallel, in an order that changes from run to run.
        parameters[NORMALS] = vertex_normals(vertices, mesh.faces, mesh.groups)[used].ravel()
        parameters.update()
    return shape


def vertices_of(mesh: Mesh, faces: range | None) -> Any:
    """Return the sorted numbers of the vertices of some faces, or a slice of all for all faces (None)."""
    return slice(None) if faces is None else np.unique(mesh.faces[faces.start : faces.stop])


def vertex_normals(vertices: Array, faces: Array, groups: Array | None = None) -> Array:
    """Return unit normals, float32 [V, 3]: face normals weighted by corner angle, summed in a fixed order.

    Vertices of one number in `groups` [V] have one normal, of all their faces.
    """
    corners = np.asarray(vertices, np.float64)[faces]  # [F, 3, 3]
    edges = np.roll(corners, -1, axis=1) - corners
    face = np.cross(edges[:, 0], -edges[:, 2])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    angles = np.arccos(np.clip(-np.einsum("fik,fik->fi", unit, np.roll(unit, 1, axis=1)), -1, 1))
    summed = np.zeros((len(vertices), 3))
    np.add.at(summed, faces if groups is None else groups[faces], angles[..., None] * face[:, None])
    if groups is not None:
        summed = summed[groups]
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 0, summed / np.maximum(length, 1e-300), (0.0, 0.0, 1.0)).astype(np.float32)
