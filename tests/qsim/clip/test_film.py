"""Tests pictures and films of notebooks: the frames that a viewer decodes are the frames."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image, ImageSequence

from qsim import colour
from qsim.clip.film import MOST_FRAMES, Film, card
from qsim.lazy_array import LazyArray


def decoded(html: str) -> list[np.ndarray]:
    """The frames of the picture in HTML, uint8 [H, W]."""
    data = re.search(r'src="data:image/(?:png|gif);base64,([^"]+)"', html)
    assert data is not None
    image = Image.open(io.BytesIO(base64.b64decode(data[1])))
    return [np.asarray(frame.convert("L")) for frame in ImageSequence.Iterator(image)]


def frames_of(array: np.ndarray) -> LazyArray:
    return LazyArray(array.shape, array.dtype, lambda start, stop, crop: array[start:stop])


def test_a_film_holds_the_frames_with_the_tone_curve_of_all_pictures():
    array = np.random.default_rng(0).random((5, 8, 11)).astype(np.float32)
    film = Film.of("fan", frames_of(array), 1, 4, 10.0)
    white = colour.peak(array[1:4])
    assert film.caption == f"fan, frames 1..3 of 5, brightest shown = {white:.4g}"
    found = decoded(film._repr_html_())
    assert len(found) == 3
    np.testing.assert_array_equal(np.stack(found), colour.tone(array[1:4], white))
    assert "qsim preview" in repr(film)


def test_a_long_film_is_cut_and_states_it():
    film = Film.of("long", frames_of(np.ones((MOST_FRAMES + 5, 1, 2), np.uint8)), 0, None, 12.0)
    assert len(film.pictures) == MOST_FRAMES
    assert "frames 0..99 of 105" in film.caption


def test_frames_and_speeds_that_do_not_exist_are_refused():
    frames = frames_of(np.ones((3, 2, 2), np.uint8))
    for start, stop in ((-1, None), (3, None), (0, 4), (2, 2)):
        with pytest.raises(ValueError, match=r"fan: frames .* do not all exist; there are 0\.\.2"):
            Film.of("fan", frames, start, stop, 12.0)
    for fps in (0.0, -1.0, 51.0, float("nan")):
        with pytest.raises(ValueError, match="at most 50 frames per second"):
            Film.of("fan", frames, 0, None, fps)


def test_a_card_escapes_its_text():
    html = card('<Clip <b>&"x">', np.zeros((2, 3), np.uint8))
    assert "<b>" not in html
    assert "&lt;b&gt;&amp;" in html
    np.testing.assert_array_equal(decoded(html)[0], np.zeros((2, 3), np.uint8))
