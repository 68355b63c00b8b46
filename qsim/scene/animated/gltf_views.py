"""Reads the cameras and lights of a glTF file.

    node -> Camera, PointLight, SpotLight or DirectionalLight, which follow the node

Lights are in candela and lux: a radiant quantity is the luminous one divided by LUMENS_PER_WATT, as Blender's exporter
multiplies watts. Sources: Khronos, glTF 2.0, section 3.10, and KHR_lights_punctual.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from msgspec import Meta

from qsim.kinds import Number, Part
from qsim.optics.camera import Camera
from qsim.records import convert
from qsim.scene.animated.attached import Attached, inverse, placement, rigid_part
from qsim.scene.animated.gltf_buffers import Document, entries_of
from qsim.scene.animated.gltf_surfaces import tint
from qsim.scene.animated.skinning import Placed
from qsim.scene.animated.tracks import Clock
from qsim.scene.lights import WIDEST, DirectionalLight, PointLight, SpotLight
from qsim.scene.rotation import vector

PUNCTUAL = "KHR_lights_punctual"
BLENDER = "Blender"  # in the name of its exporter
LUMENS_PER_WATT = 683.0  # of light at 555 nm
HEIGHT = 512  # px of a camera that was not resized
PITCH = 1.1e-6  # m
F_NUMBER = 2.8
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from our camera's axes (x right, y down, z forward) to those of glTF

Strength = Annotated[float, Meta(ge=0.0, le=1e15)]
Angle = Annotated[float, Meta(gt=0.0, lt=math.pi)]


class Perspective(TypedDict):
    yfov: Angle
    aspectRatio: NotRequired[Annotated[float, Meta(ge=0.01, le=100.0)]]


class CameraEntry(TypedDict):
    type: Literal["perspective", "orthographic"]
    name: NotRequired[str]
    perspective: NotRequired[Perspective]


class Cone(TypedDict):
    innerConeAngle: NotRequired[Number]
    outerConeAngle: NotRequired[Number]


class Extended(TypedDict):
    extensions: NotRequired[dict[str, dict[str, Any]]]


class LightEntry(TypedDict):
    type: Literal["directional", "point", "spot"]
    color: NotRequired[tuple[Part, Part, Part]]
    intensity: NotRequired[Strength]
    spot: NotRequired[Cone]


def camera_names(document: Document, nodes: list[tuple[str, int]]) -> list[str]:
    """Return a name for each (name of a node, number of its camera): that of the node, else of the camera."""
    found: list[str] = []
    for name, number in nodes:
        own = document.entry("cameras", number, CameraEntry, "a node").get("name", "")
        name = name or own or f"camera {number}"
        found.append(f"{name} #{len(found)}" if name in found else name)
    return found


def camera_of(document: Document, number: int, chain: tuple[Placed, ...], clock: Clock, moves: bool) -> Camera:
    """Return a camera that follows its node; `ValueError` for an orthographic one."""
    about = document.entry("cameras", number, CameraEntry, "a node")
    if about["type"] != "perspective" or "perspective" not in about:
        raise ValueError(f"{document.path}: cameras[{number}] is orthographic; export a perspective camera")
    lens = about["perspective"]
    place = rigid_part(placement(chain, clock.at(0.0)))
    if np.linalg.det(place) < 0:
        raise ValueError(f"{document.path}: cameras[{number}] is mirrored by a negative scale; apply the scale")
    view = place @ FLIP
    motion = Attached(chain, clock, before=inverse(view), after=FLIP) if moves else None
    return Camera(
        focal_length=HEIGHT / 2 * PITCH / math.tan(lens["yfov"] / 2),
        f_number=F_NUMBER,
        pixel_pitch=PITCH,
        height=HEIGHT,
        width=max(1, round(HEIGHT * lens.get("aspectRatio", 1.0))),
        origin=vector(view[:3, 3]),
        target=vector(view[:3, 3] + view[:3, 2]),
        up=vector(-view[:3, 1]),
        motion=motion,
    )


def light_of(
    document: Document, number: int, by: str, chain: tuple[Placed, ...], clock: Clock, moves: bool, coloured: bool
) -> PointLight | SpotLight | DirectionalLight:
    """Return a light that follows its node, in W, sr and m."""
    about_file = convert(document.content, Extended, str(document.path))
    extension = about_file.get("extensions", {}).get(PUNCTUAL, {})
    where = f"{document.path}: {PUNCTUAL}.lights[{number}]"
    lights = entries_of(document.path, extension, "lights")
    if number >= len(lights):
        raise ValueError(f"{where}: {by} names it; there are {len(lights)}")
    about = convert(lights[number], LightEntry, where)
    watts = about.get("intensity", 1.0) / LUMENS_PER_WATT
    strength = tint([part * watts for part in about.get("color", (1.0, 1.0, 1.0))], coloured)
    place = rigid_part(placement(chain, clock.at(0.0)))
    motion = Attached(chain, clock, after=inverse(place)) if moves else None
    position = vector(place[:3, 3])
    direction = vector(-place[:3, 2])
    if about["type"] == "point":
        return PointLight(position, strength, motion)
    if about["type"] == "directional":
        return DirectionalLight(direction, strength, motion)
    cone = about.get("spot", Cone())
    outer = cone.get("outerConeAngle", math.pi / 4)
    inner = cone.get("innerConeAngle", 0.0)
    if not 0 <= inner < outer <= math.pi / 2:
        raise ValueError(f"{where}: its cone needs 0 <= inner < outer <= pi / 2, found {inner:g} and {outer:g}")
    outer = min(outer, WIDEST)
    smooth = BLENDER in str(document.content["asset"].get("generator", ""))
    if smooth:
        # Blender states the width of the edge as a share of the angle, and computes it as that share of the cosine.
        inner = math.acos(math.cos(outer) + (1 - math.cos(outer)) * (1 - inner / outer))
    return SpotLight(position, direction, strength, outer, min(inner, 0.999 * outer), smooth, motion)
