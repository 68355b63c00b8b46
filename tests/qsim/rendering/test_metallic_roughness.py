"""The surface of glTF as a plugin: its density, its light, spots, parallel light and holes."""

from __future__ import annotations

import math

import numpy as np
import pytest

import qsim
from qsim.rendering import metallic_roughness
from qsim.rendering.engine import select
from qsim.scene import (
    Body,
    Camera,
    Constant,
    Diffuse,
    DirectionalLight,
    MetallicRoughness,
    Scene,
    SpotLight,
    Texture,
    Translation,
    VertexColours,
)
from qsim.scene.shapes import sheet

SURFACES = [
    {"base_color": 0.7, "metallic": 0.0, "roughness": 0.6},
    {"base_color": 0.9, "metallic": 1.0, "roughness": 0.5},
    {"base_color": 0.5, "metallic": 0.4, "roughness": 0.3, "clearcoat": 0.8, "clearcoat_alpha": 0.2},
]


@pytest.mark.parametrize("numbers", SURFACES)
def test_samples_follow_the_density_and_give_the_value(numbers):
    """The mean of sampled weights is the integral of the value, and the density integrates to 1 or less."""
    select()
    import mitsuba as mi

    if mi.variant().startswith("scalar"):
        pytest.skip("the scalar engine has Mitsuba's own surface")
    import drjit as dr

    metallic_roughness.register(mi)
    textures = {name: mi.load_dict({"type": "uniform", "value": numbers[name]}) for name in list(numbers)[:3]}
    surface = mi.load_dict({"type": metallic_roughness.NAME, "reflection": 0.04} | numbers | textures)
    count = 1 << 18
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    for angle in (0.1, 1.0, 1.4):
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.wi = mi.Vector3f(math.sin(angle), 0, math.cos(angle))
        _, weight = surface.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
        drawn = np.array(weight[0])
        evenly = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
        value = np.array(surface.eval(mi.BSDFContext(), si, evenly)[0]) * 2 * math.pi
        density = np.array(surface.pdf(mi.BSDFContext(), si, evenly)) * 2 * math.pi
        error = math.hypot(drawn.std(), value.std()) / math.sqrt(count)
        assert abs(drawn.mean() - value.mean()) < 5 * error
        assert drawn.mean() < 1 + 5 * error
        assert density.mean() < 1 + 5 * density.std() / math.sqrt(count)
        back = dr.zeros(mi.SurfaceInteraction3f, count)
        back.wi = mi.Vector3f(math.sin(angle), 0, -math.cos(angle))
        mirrored = surface.eval(mi.BSDFContext(), back, evenly * mi.Vector3f(1, 1, -1))
        np.testing.assert_array_equal(np.array(mirrored[0]) * 2 * math.pi, value)


def lit(material, lights, size=9, extra=()):
    """Return the mean radiance of a sheet, seen from 3 m, that faces the camera."""
    camera = Camera(8e-3, 2.8, 1.1e-6, size, size, origin=(0, 0, 3), target=(0, 0, 0), vignetting=False)
    scene = Scene("sheet", 0, camera, lights, (Body("sheet", sheet(1, 1), material), *extra))
    clip = qsim.render(scene, frames=1, psnr=40)
    return clip.radiance(0)[size // 2, size // 2], clip


def test_parallel_light_and_a_spot_have_the_radiance_of_a_diffuse_sheet():
    matt = MetallicRoughness(0.5, roughness=1.0, ior=1.001)
    slanted = DirectionalLight((0, -1, -1), 2.0)
    found, _ = lit(matt, (slanted,))
    assert found == pytest.approx(0.5 / math.pi * 2.0 * math.sqrt(0.5), rel=2e-3)
    spot = SpotLight((0, 0, 2), (0, 0, -1), 4.0, outer=0.5, inner=0.1)
    found, _ = lit(matt, (spot,))
    assert found == pytest.approx(0.5 / math.pi * 4.0 / 4, rel=2e-3)
    aside = (math.sin(0.3), 0, -math.cos(0.3))
    share = (math.cos(0.3) - math.cos(0.5)) / (math.cos(0.1) - math.cos(0.5))
    for smooth, edge in ((False, share**2), (True, share**2 * (3 - 2 * share))):
        found, _ = lit(matt, (SpotLight((0, 0, 2), aside, 4.0, 0.5, 0.1, smooth),))
        assert found == pytest.approx(0.5 / math.pi * 4.0 / 4 * edge, rel=5e-3)


def test_emission_and_colours_of_vertices_are_seen():
    found, _ = lit(MetallicRoughness(0.0, ior=1.001, emission=3.0), (Constant(0.0),))
    assert found == pytest.approx(3.0, rel=1e-3)
    colours = VertexColours(np.full((4, 3), 0.25))
    found, _ = lit(MetallicRoughness(colours, roughness=1.0, ior=1.001), (Constant(1.0),))
    assert found == pytest.approx(0.25, rel=1e-2)  # its coat of index 1.001 dims grazing light


def test_light_and_truth_pass_through_holes():
    """A lamp shines through a hole, and depth and flow there are those of what is behind."""
    holes = np.ones((9, 9), np.float32)
    holes[3:6, 3:6] = 0
    plate = MetallicRoughness(0.2, roughness=1.0, ior=1.001, opacity=Texture(holes, nearest=True))
    wall = Body("wall", sheet(4, 4), Diffuse(0.5), Translation((0.4, 0, 0), (0, 0, -1)))
    middle, clip = lit(plate, (DirectionalLight((0, 0, -1), 2.0),), extra=(wall,))
    assert middle == pytest.approx(0.5 / math.pi * 2, rel=5e-3)
    assert clip.body_id(0)[4, 4] == 1
    assert clip.depth(0)[4, 4] == pytest.approx(4, rel=1e-4)
    assert clip.flow(0)[0, 4, 4] > 0
