"""The pilot: it finds bodies and fast frames, and does not rely on chance."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_scenes import CAMERA, plate, scene, square

from qsim.clip.clamped_error import Errors, error_at, white_in
from qsim.colour import psnr
from qsim.rendering import pilot
from qsim.rendering.budget import Allowed
from qsim.rendering.denoiser import OPTIX, available
from qsim.rendering.fidelity import choose_budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Body, Diffuse, Glow, Oscillation, SunSky, Texture


def test_frames_with_fast_motion_that_the_others_miss_are_added():
    """A slat out of view rests in frames 0, 10 and 20, and moves in 5 and 15."""
    swing = Oscillation((1.0, 0.0, 0.0), 100.0, math.pi / 2, (0.0, 50.0, 0.0))
    made = scene(Body("wall", square(12, -1), Diffuse(0.2)), Body("slat", square(0.5), Diffuse(0.9), swing))
    seen = pilot.Pilot.of(made, 2000.0, 1.0, 21, 0)
    assert {0, 10, 20} < set(seen.times)
    assert {5, 15} & set(seen.times)
    assert pilot.Pilot.of(made, 2000.0, 0.0, 21, 0).times == (0, 10, 20)
    assert not pilot.rests(made)
    assert pilot.rests(plate(None))


def test_an_error_that_hardly_falls_needs_nearly_infinite_samples():
    assert pilot.needed_samples([8, 32, 128], [1.0, 0.99999], 0.1) > 1e30
    assert pilot.needed_samples([8, 32, 128], [1.0, 1.1], 0.1) == math.inf
    assert pilot.needed_samples([8, 32, 128], [1.0, 0.5], 0.25) == pytest.approx(128)


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install pyoidn")
@pytest.mark.slow
def test_the_denoiser_is_tried_beside_the_middle_of_a_large_frame():
    """A lamp without noise fills the middle: the requested error holds for the complete frame."""
    camera = CAMERA.resized(256, 512)
    lamp = Body("lamp", square(200 / camera.focal_pixels * 4), Glow(0.3))
    leaves = Texture(np.random.default_rng(1).random((96, 96)), nearest=True)
    made = scene(Body("wall", square(12, -1), Diffuse(leaves)), lamp, light=SunSky(), camera=camera)
    chosen = choose_budget(made, psnr=42, denoise=True)
    frame = Renderer(made, budget=chosen).frame(3, with_truth=False)
    white = white_in(frame.radiance)
    assert psnr(white, error_at(white, frame.errors_at)) > 41


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install pyoidn")
def test_a_denoised_trial_with_far_less_noise_than_the_pilots_is_rejected():
    """Its windows missed the rare bright paths that the pilots found."""
    made = plate(None, light=SunSky(), camera=replace(CAMERA, height=48, width=64))
    loaded = pilot.Pilot.of(made, 2000.0, 0.0, 1, 0)
    allowed = Allowed(white=10.0, target=0.02)
    lucky, plain = (
        pilot.denoised_samples(
            loaded, pilot.Trials(1), 2, allowed, 1.0, 5000, None, lambda n, noise=noise: Errors(noise, noise)
        )[0]
        for noise in (100.0, 0.0)
    )
    assert lucky is None
    assert plain is not None


@pytest.mark.parametrize(
    ("over", "chosen"),
    [
        (0.55, (4, "fast")),  # 4 + 5: all three reach the error with the fewest samples
        (0.63, (4, "balanced")),  # 4 + 7.5: fast needs 8
        (0.7, (8, "fast")),  # 8 + 5: the best alone reaches it with 4, for 4 + 15
        (0.85, (8, "balanced")),  # 8 + 7.5: fast does not
        (0.95, (8, "high")),  # 8 + 15: the others do not, and high ends the trials
        (1.3, (24, "fast")),  # needs 21.1: 24 + 5, against 24 + 7.5 for 16.4 and 16 + 15 for 13.5
        (1.7, (24, "high")),  # needs 23.1: 24 + 15; fast needs 36 samples, balanced 28 (32 + 7.5 = 39.5)
        (2.5, (60, "high")),  # needs 50
        (7.0, None),  # needs 392, more than raw samples
    ],
)
def test_the_cheapest_quality_of_the_denoiser_that_reaches_the_error_is_chosen(monkeypatch, over, chosen):
    """Errors of 1, 1.1 and 1.25 times `over`, falling by the root of the samples from 8 on, where 1 is allowed."""
    found, about = chosen_of(monkeypatch, over, {"high": 1.0, "balanced": 1.1, "fast": 1.25})
    assert found == chosen
    assert (f"{chosen[1]} quality" if chosen else "off") in about.chosen


@pytest.mark.parametrize(
    ("over", "factor", "chosen"),
    [
        (0.7, 1.0, (4, OPTIX)),  # 4 + 5: as good as high, whose 4 + 15 is more than the 8 + 5 of fast
        (1.7, 1.0, (24, OPTIX)),  # 24 + 5 in place of 24 + 15
        (1.7, 1.3, (24, "high")),  # worse than fast: what is chosen without it
        (0.7, 9.0, (8, "fast")),  # far too wrong
        (7.0, 1.0, None),  # more than raw samples
    ],
)
def test_the_denoiser_of_a_gpu_is_one_more_candidate(monkeypatch, over, factor, chosen):
    """Its errors are `factor` times those of high, at the cost of fast; nothing of it runs here."""
    monkeypatch.setattr(pilot, "kinds", lambda variant: ("high", "balanced", "fast", OPTIX))
    found, about = chosen_of(monkeypatch, over, {"high": 1.0, "balanced": 1.1, "fast": 1.25, OPTIX: factor})
    assert found == chosen
    assert ("OptiX" in about.chosen) == (chosen is not None and chosen[1] == OPTIX)


def chosen_of(monkeypatch, over, factors):
    """Return what is chosen where the denoisers have these errors; 1 is allowed."""

    def cleaned(halves, _albedo, _normal, _white, quality):
        error = over * factors[quality] * math.sqrt(8 / halves[0, 0, 0])
        return SimpleNamespace(error=error, error_at=lambda white, sigmas: error)

    monkeypatch.setattr(pilot, "available", lambda: True)
    monkeypatch.setattr(pilot, "cleaned_mean", cleaned)
    monkeypatch.setattr(Renderer, "surfaces", lambda *_: (None, None))
    monkeypatch.setattr(Renderer, "halves", lambda _, times, budget, key: np.full((2, 4, 4), float(budget.samples)))
    made = plate(None, camera=replace(CAMERA, height=48, width=64))
    loaded = pilot.Pilot(Renderer(made), np.zeros((1, 48, 64)), 0, (0,))
    return pilot.denoised_samples(
        loaded, pilot.Trials(1), 2, Allowed(10.0, 1.0), 1.0, 300, None, lambda samples: Errors(0.0, 0.0)
    )
