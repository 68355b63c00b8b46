"""Tests the parts of a page: self-contained, escaped, consistent."""

import re

import numpy as np
import pytest

from qsim.report.html import MAX_STRIP, Panel, Table, figure, number_text, page, player, section, strip, table


def frames(t: int = 3, h: int = 5, w: int = 7) -> np.ndarray:
    return np.arange(t * h * w, dtype=np.uint8).reshape(t, h, w)


def test_page_loads_nothing_from_elsewhere():
    body = section("A scene", player([Panel("truth", frames()), Panel("codes", frames())]))
    text = page("Title", "subtitle", [body])
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', text)
    assert addresses
    assert all(a.startswith("data:") for a in addresses)
    assert "{{" not in text


def test_text_is_escaped():
    text = page("<b>", "&", [section("<i>", table(Table("c", ["<x>"], [["a<b"]])))])
    assert "<b>" not in text.replace("<body>", "")
    assert "a&lt;b" in text


def test_strip_holds_every_frame_exactly():
    import base64
    import io

    from PIL import Image

    encoded = strip(frames()).split(",")[1]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))))
    assert np.array_equal(picture.reshape(3, 5, 7), frames())


def test_too_many_rows_are_refused_with_the_limit():
    with pytest.raises(ValueError, match=str(MAX_STRIP)):
        strip(np.zeros((MAX_STRIP + 1, 1, 1), np.uint8))


def test_panels_of_one_player_have_equal_length():
    with pytest.raises(ValueError, match="'b' has 2 frames, the first has 3"):
        player([Panel("a", frames(3)), Panel("b", frames(2))])


def test_numbers_are_aligned_and_none_is_a_dash():
    text = table(Table("t", ["name", "dB"], [["mean", 20.12345], ["none", None]], best=frozenset({0})))
    assert '<td class="number">20.12</td>' in text
    assert '<td class="number">–</td>' in text
    assert "<td>mean</td>" in text
    assert "class=best" in text
    assert number_text(3) == "3"


def test_figure_embeds_its_bytes():
    assert "data:image/png;base64,aGk=" in figure(b"hi", "caption")
