"""Scene records: what makes no sense is refused with one clear line."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest

from qsim.optics.camera import Camera
from qsim.scene import (
    AreaLamp,
    Body,
    Bump,
    Constant,
    Diffuse,
    EnvironmentImage,
    Glow,
    Mesh,
    NormalMap,
    PointLight,
    Scene,
    Spin,
    SunSky,
    Texture,
    Translation,
    describe,
)

TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]))
MAPPED = Mesh(TRIANGLE.vertices, TRIANGLE.faces, np.eye(3)[:, :2])
CAMERA = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1e-5, height=7, width=10)


LIGHT = Constant(1.0)
BODY = Body("a", TRIANGLE)


def scene(lights=(LIGHT,), bodies=(BODY,)) -> Scene:
    return Scene("s", 0, CAMERA, tuple(lights), tuple(bodies))


def test_a_mesh_with_nan_names_the_vertex():
    vertices = np.eye(3)
    vertices[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"Mesh.vertices: nan at index \(1, 2\)"):
        Mesh(vertices, np.array([[0, 1, 2]]))


@pytest.mark.parametrize("faces", [np.zeros((0, 3), int), np.array([[0, 1, 3]]), np.array([[0, 1]])])
def test_faces_must_be_triangles_of_the_mesh(faces):
    with pytest.raises(ValueError, match="Mesh"):
        Mesh(np.eye(3), faces)


def test_a_scene_without_light_is_refused_and_a_glowing_body_is_light():
    for lights in ((), (Constant(0.0),), (PointLight((0, 1, 0), 0.0),), (SunSky(sun_irradiance=0, sky_irradiance=0),)):
        with pytest.raises(ValueError, match="no light and no glowing body"):
            scene(lights)
    assert scene((), (Body("lamp", TRIANGLE, Glow(1.0)),)).emits()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PointLight(Spin((0, 1, 0), 1.0), 20.0), r"PointLight.position: expected numbers, got Spin"),
        (lambda: PointLight((0, 1), 20.0), r"PointLight.position: expected three finite numbers"),
        (lambda: AreaLamp((0, 1, 0), (0, 0, np.nan), 1, 1, 1.0), r"AreaLamp.target: expected three finite numbers"),
        (lambda: AreaLamp((0, 1, 0), (0, 0, 0), np.inf, 1, 1.0), r"AreaLamp.width: expected a finite number"),
        (lambda: SunSky(elevation="0.8"), r"SunSky.elevation: expected numbers, got '0.8'"),
        (lambda: EnvironmentImage("sky.exr", rotation=np.nan), r"EnvironmentImage.rotation: expected a finite number"),
        (lambda: EnvironmentImage("sky.exr", scale=-1.0), r"EnvironmentImage.scale: a finite number from 0 up"),
        (lambda: SunSky(ground_reflectance=1.5), r"SunSky.ground_reflectance: a share from 0 to 1 is needed, got 1.5"),
        (lambda: SunSky(sun_radius=0.0), r"SunSky.sun_radius: an angle .* between 0 and pi/2 is needed, got 0.0"),
        (lambda: SunSky(elevation=80.0), r"SunSky.elevation: an angle .* from -pi/2 to pi/2 is needed, got 80.0"),
        (lambda: SunSky(elevation=-0.1), r"SunSky.elevation: the sun is below the horizon; give sun_irradiance=0"),
    ],
)
def test_a_light_of_wrong_numbers_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_sky_without_sun_may_have_it_below_the_horizon():
    assert SunSky(elevation=-0.1, sun_irradiance=0).elevation < 0


def test_only_one_light_may_surround_the_scene():
    with pytest.raises(ValueError, match="Constant and SunSky"):
        scene((Constant(1.0), SunSky()))


def test_two_bodies_of_one_name_are_refused():
    with pytest.raises(ValueError, match="'a' more than once"):
        scene(bodies=(Body("a", TRIANGLE), Body("a", TRIANGLE)))


@dataclass(frozen=True)
class Lost:
    def pose(self, t):
        return np.full((4, 4), np.nan)

    def velocity(self, t):
        return np.zeros(3), np.zeros(3)


def test_a_motion_without_a_pose_names_the_body():
    with pytest.raises(ValueError, match="scene s, body a: motion"):
        scene(bodies=(Body("a", TRIANGLE, motion=Lost()),))


def test_a_description_is_json_and_distinguishes_textures():
    bodies = [Body("a", MAPPED, Diffuse(Texture(np.full((5, 5), v))), Translation((1, 0, 0))) for v in (0.1, 0.2)]
    texts = [json.dumps(scene(bodies=(body,)).to_dict()) for body in bodies]
    assert texts[0] != texts[1]
    assert describe(np.float32(2)) == 2.0
    assert describe(np.array([1j])) == describe([np.complex128(1j)]) == [[0.0, 1.0]]
    assert describe(np.array([None] * 20, object)) == [None] * 20


def test_a_black_environment_does_not_count_as_light():
    with pytest.raises(ValueError, match="no light"):
        scene((EnvironmentImage(np.zeros((4, 8))),))


@pytest.mark.parametrize(
    "material",
    [
        Diffuse(Texture(np.full((5, 5), 0.5))),
        Diffuse(0.5, Bump(Texture(np.full((5, 5), 0.5)))),
        Diffuse(0.5, NormalMap(np.full((5, 5, 3), 0.5))),
    ],
    ids=["texture", "bump", "normal map"],
)
def test_a_picture_needs_texture_coordinates(material):
    with pytest.raises(ValueError, match=r"body a: its material shows a picture, .* give Mesh uv=, or build it with"):
        Body("a", TRIANGLE, material)
    assert Body("a", MAPPED, material).mesh is MAPPED
