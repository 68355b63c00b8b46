"""Tests which measured place stands for a motion and a light, and what is said of it."""

import pytest

from qsim.studies.bit_depth import restored_bits


@pytest.mark.parametrize("place", restored_bits.table())
def test_every_place_is_found_and_its_best_depth_named(place):
    assert restored_bits.nearest(place.px, place.ppp) == place
    text = restored_bits.sentence(place.px, place.ppp)
    assert f"{place.best} bit" in text.split(",")[0]
    assert (">=" in text) == (place.best == max(place.psnr_db))
    losses = [
        place.psnr_db[place.best] - place.psnr_db[b] for b in restored_bits.beside(place.best, list(place.psnr_db))
    ]
    assert " and ".join(f"{loss:.1f}" for loss in losses) + " dB worse" in text
    assert restored_bits.PAGE in text


@pytest.mark.parametrize(("px", "ppp"), [(33.0, 0.5), (4.0, 0.0099), (4.0, 17.0), (0.0, 1e6), (1e-3, 1e-3)])
def test_nothing_is_said_far_from_what_was_measured(px, ppp):
    assert restored_bits.nearest(px, ppp) is None
    assert (
        restored_bits.sentence(px, ppp) == f"what restoring changes was not measured near here ({restored_bits.PAGE})"
    )


@pytest.mark.parametrize(("px", "taken"), [(0.0, 0.0), (0.24, 0.0), (0.26, 0.5), (2.7, 2.0), (3.0, 4.0), (32.0, 16.0)])
def test_the_nearest_motion_is_taken(px, taken):
    assert restored_bits.nearest(px, 0.1).px == taken
