"""Tests three bands against one: a colour scene is three grey scenes on the same paths."""

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, plate, renderer, square

from qsim.backend import RenderEngine
from qsim.optics.radiometry import RGB
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.fidelity import choose_budget
from qsim.rendering.renderer import fireflies_in
from qsim.scene import AreaLamp, Body, Constant, Diffuse, EnvironmentImage, Glow, Scene, Spin, SunSky, Texture

PAINT = np.random.default_rng(3).random((5, 7, 3)).astype(np.float32)
LIGHTS = [
    Constant((0.7, 0.4, 1.2)),
    SunSky(sun_irradiance=(5.0, 3.0, 1.0), sky_irradiance=0.5),
    AreaLamp((1, 2, 3), (0, 0, 0), 1.0, 1.0, (9.0, 4.0, 0.2)),
    EnvironmentImage(np.random.default_rng(4).random((4, 8, 3)).astype(np.float32)),
]


def coloured(light, band: int | None) -> Scene:
    """A turning plate and a glowing square before a wall; all of it in colour, or one band of it in grey."""

    def of(value):
        return value if band is None or isinstance(value, float) else value[band]

    images = {"image": light.image[..., band]} if isinstance(light, EnvironmentImage) and band is not None else {}
    names = [name for name in ("radiance", "sun_irradiance", "sky_irradiance") if hasattr(light, name)]
    lit = replace(light, **images, **{name: of(getattr(light, name)) for name in names})
    texture = Texture(PAINT if band is None else PAINT[..., band])
    bodies = (
        Body("wall", square(12, -1), Diffuse(of((0.3, 0.9, 0.5)))),
        Body("plate", square(1.6), Diffuse(texture), Spin((0, 0, 1), 300.0)),
        Body("sign", square(0.3, 0.5), Glow(of((1.0, 3.0, 0.0)))),
    )
    return Scene("test", 0, CAMERA, (lit,), bodies, bands=RGB if band is None else None)


@pytest.mark.parametrize("light", [LIGHTS[0], *(pytest.param(light, marks=pytest.mark.slow) for light in LIGHTS[1:])])
def test_each_band_is_the_grey_scene_of_that_band(light):
    """Diffuse surfaces scatter alike in every band, so the paths are the same and only rounding may differ.

    Maps of the surroundings are sampled by their luminance: there the pictures agree within their noise.
    """
    found = renderer(coloured(light, None)).frame(2)
    assert found.radiance.shape == (3, 24, 33)
    for band in range(3):
        one = renderer(coloured(light, band)).frame(2)
        if isinstance(light, Constant | AreaLamp):
            np.testing.assert_allclose(found.radiance[band], one.radiance, rtol=1e-5, atol=1e-6 * one.radiance.max())
        else:
            noise = np.hypot(found.error, one.error)
            assert np.abs(found.radiance[band] - one.radiance).mean() < noise
            assert abs(found.radiance[band].mean() - one.radiance.mean()) < 5 * noise / np.sqrt(one.radiance.size)
        for name, truth in one.truth.items():
            np.testing.assert_array_equal(found.truth[name], truth)


def test_a_grey_scene_has_three_equal_bands():
    grey = plate(Spin((0, 0, 1), 200.0))
    one, three = (renderer(scene, shutter=0.5).frame(1) for scene in (grey, replace(grey, bands=RGB)))
    for band in range(3):
        np.testing.assert_allclose(three.radiance[band], one.radiance, rtol=1e-6)
        np.testing.assert_allclose(three.sharp[band], one.sharp, rtol=1e-6)
    assert three.error == pytest.approx(one.error, rel=1e-6)
    assert three.errors_at[-1][1] == pytest.approx(one.errors_at[-1][1], rel=1e-5), "hardly anything is clamped there"


def test_a_window_and_thinned_pixels_have_three_bands():
    scene = coloured(LIGHTS[0], None)
    crop = renderer(scene, crop=(3, 4, 5, 7)).frame(0, with_truth=False).radiance
    thin = renderer(scene, thinned=4)
    assert crop.shape == (3, 5, 7)
    assert thin.halves([0.0], Budget(8, 2), thin.key(0)).shape == (2, 3, 6, 9)
    assert thin.window((1, 2, 3, 5)).halves([0.0], Budget(8, 2), thin.key(0)).shape == (2, 3, 3, 5)


def test_a_firefly_in_three_bands_is_one_pixel():
    halves = np.zeros((2, 3, 24, 33))
    halves[0, :, 2, 3] = halves[0, 1, 5, 7] = 1.0
    broken = np.zeros((3, 24, 33), bool)
    broken[0, 9, 9] = broken[2, 9, 9] = True
    found = fireflies_in(halves, broken)
    assert sorted(map(tuple, np.argwhere(found).tolist())) == [(2, 3), (5, 7), (9, 9)]
    np.testing.assert_array_equal(fireflies_in(halves[:, 1], broken[0]), found)


@pytest.mark.slow
def test_the_stated_error_is_the_error_of_all_bands():
    """The sky reaches every pixel directly or after one bounce: 4096 samples are the truth beside 8."""
    scene = coloured(LIGHTS[1], None)
    truth = renderer(scene, Budget(samples=4096, bounces=2)).frame(0, with_truth=False)
    found = [renderer(scene, Budget(samples=8, bounces=2), seed=seed).frame(0, with_truth=False) for seed in range(4)]
    errors = [np.sqrt(np.mean((frame.radiance - truth.radiance) ** 2)) for frame in found]
    assert np.mean(errors) == pytest.approx(np.mean([frame.error for frame in found]), rel=0.15)


@pytest.mark.slow
def test_denoised_bands_keep_their_light():
    pytest.importorskip("pyoidn")
    scene = coloured(LIGHTS[2], None)
    plain = renderer(scene, Budget(samples=8, bounces=2)).frame(0, with_truth=False)
    clean = renderer(scene, Budget(samples=8, bounces=2, denoise=True)).frame(0, with_truth=False)
    truth = renderer(scene, Budget(samples=1024, bounces=2)).frame(0, with_truth=False).radiance
    assert np.sqrt(np.mean((clean.radiance - truth) ** 2)) < 1.5 * clean.error, "the stated error holds in colour"
    np.testing.assert_allclose(clean.radiance.mean((1, 2)), plain.radiance.mean((1, 2)), atol=plain.error)
    assert clean.radiance[2].max() < 0.1 * clean.radiance[0].max(), "lamp and sign have hardly any blue"


@pytest.mark.slow
def test_a_budget_is_chosen_and_a_clip_states_its_bands(tmp_path):
    scene = coloured(LIGHTS[0], None)
    budget = choose_budget(scene, frames=2, psnr=30, ppp=3.0)
    clip = render_clip(scene, tmp_path / "c", frames=2, budget=budget)
    assert clip.bands == RGB
    assert clip.shape == (2, 24, 33)
    assert clip[1].shape == (3, 24, 33)
    assert clip.info.psnr_of_truth > 28
    assert clip.info.render.variant.endswith("_rgb")


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"a Constant has a colour; give the scene bands=qsim\.optics\.RGB"):
        Scene("s", 0, CAMERA, (Constant((1.0, 1.0, 1.0)),), ())
    with pytest.raises(ValueError, match="bands are three wavelengths in m"):
        Scene("s", 0, CAMERA, (Constant(1.0),), (), bands=(610, 540, 460))
    with pytest.raises(ValueError, match="from 0 to 1"):
        Diffuse((0.5, 0.5, 1.5))
    with pytest.raises(ValueError, match="from 0 up"):
        Constant((0.5, -0.5, 1.5))
    with pytest.raises(ValueError, match="renders one band only"):
        renderer(coloured(LIGHTS[0], None), engine=RenderEngine("scalar_rgb", "scalar", None, "asked for"))
