"""Budgets of frames that share samples: memory, cost, what is chosen, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import CAMERA, plate

from qsim.clip.clamped_error import Errors, white_in
from qsim.rendering.budget import Allowed
from qsim.rendering.fidelity import choose_budget
from qsim.rendering.pilot import Pilot
from qsim.rendering.reuse.carrying import Carrier
from qsim.rendering.reuse.sharing import (
    MOST_BYTES,
    NAME,
    SAMPLE_BYTES,
    Need,
    Sharing,
    most_neighbours,
    shared_samples,
)
from qsim.scene import Spin, SunSky


def test_the_kept_samples_fit_into_memory():
    rng = np.random.default_rng(8)
    for samples, pixels in zip(rng.integers(8, 512, 200), rng.integers(100, 4_000_000, 200), strict=True):
        k = most_neighbours(int(samples), int(pixels))
        assert k == 0 or (2 * k + 1) * samples * pixels * SAMPLE_BYTES <= MOST_BYTES
    assert most_neighbours(16, 512 * 1024) == 5
    assert most_neighbours(512, 512 * 1024) == 0


def test_small_frames_pay_for_their_kernels():
    small, large = (Sharing(8, 5, "").cost(pixels) for pixels in (24 * 33, 512 * 1024))
    assert small > 40
    assert large < 20
    assert Sharing(8, 0, "").cost(1) == 8


@pytest.fixture(scope="module")
def turning():
    """A plate that turns under sun and sky: its pilot, and an error for which raw frames need 19 to 26 samples."""
    made = plate(Spin((0, 0, 1), 20.0), light=SunSky(), camera=CAMERA.resized(40, 56))
    pilot = Pilot.of(made, 2000.0, 0.0, 9, 0)
    halves = pilot.halves(8, 2)
    white = white_in(halves.mean(axis=0))
    noise = Errors.of_halves(halves, white)
    allowed = Allowed(white, noise.at_white / 1.8)  # 8 * 1.8^(2 / 1.4) to 8 * 1.8^2 samples
    return pilot, Need(allowed, 1.0, 2, 9, Sharing(2000, 0, ""), lambda samples: Errors(0.0, 0.0))


def test_a_clip_shares_samples_where_that_costs_less(turning):
    pilot, need = turning
    found, about = shared_samples(pilot, need, False, True)
    assert 8 <= found.samples <= 32
    assert found.neighbours in (1, 2, 3, 5)
    assert not found.denoise
    assert f"{found.neighbours} frames on each side" in about.chosen
    assert about.effect == NAME


def test_a_sample_that_is_not_a_number_does_not_spoil_the_trial(turning, monkeypatch):
    pilot, need = turning
    carried = Carrier.pictures

    def broken(self, t):
        found = carried(self, t)
        found[:, 0, 3, 4] = np.nan
        return found

    monkeypatch.setattr(Carrier, "pictures", broken)
    found, _ = shared_samples(pilot, need, False, True)
    assert found.neighbours in (1, 2, 3, 5)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"alone": Sharing(20, 0, "")}, "a trial would cost more than it could save"),
        ({"frames": 1}, "not with one frame"),
        ({"allowed": Allowed(1.0, 1e-6)}, "frames alone cost no more"),
    ],
)
def test_a_clip_is_rendered_alone_where_sharing_costs_more_or_errs_more(turning, change, why):
    pilot, need = turning
    found, about = shared_samples(pilot, replace(need, **change), False, True)
    assert found.neighbours == 0
    assert (about.chosen, about.size) == ("off, each frame alone", why)


def test_small_frames_share_only_samples_by_which_their_error_is_known(turning):
    """A stricter target needs more samples, for the error and for its doubt."""
    pilot, need = turning
    strict, loose = (
        shared_samples(
            pilot, replace(need, allowed=replace(need.allowed, target=factor * need.allowed.target)), False, True
        )
        for factor in (0.6, 1.0)
    )
    assert strict[0].samples > loose[0].samples


def test_without_a_wish_a_trial_costs_little_against_the_clip(turning):
    """The same clip shares samples if it has many frames, by as many trials as cost a twentieth of it each."""
    pilot, need = turning
    found = {frames: shared_samples(pilot, replace(need, frames=frames), False)[0] for frames in (9, 2000)}
    assert found[9] is need.alone
    assert found[2000].neighbours
    assert shared_samples(pilot, replace(need, frames=2000), False, False)[0] is need.alone


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"shutter": 0.5, "reuse": True}, "not with an open shutter"),
        ({"reuse": False}, "not requested"),
        ({}, "a trial would cost over 5 % of the clip, or save nothing"),
    ],
)
def test_the_finding_says_why_frames_are_rendered_alone(options, why):
    chosen = choose_budget(plate(None), psnr=20, frames=9, **options)
    about = next(finding for finding in chosen.findings if finding.effect == NAME)
    assert chosen.neighbours == 0
    assert about.size == why


@pytest.mark.parametrize("name", ["denoise", "reuse"])
@pytest.mark.parametrize("wish", [0, 1, "no"])
def test_a_wish_is_true_false_or_none(name, wish):
    """0 was taken as no wish for False: frames could be denoised, and share samples."""
    with pytest.raises(ValueError, match=f"{name}: expected True, False or None, got {wish!r}"):
        choose_budget(plate(None), **{name: wish})
