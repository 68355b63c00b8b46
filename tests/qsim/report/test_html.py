"""Tests the parts of a page: self-contained, escaped, consistent."""

import re

import numpy as np
import pytest

from qsim.report.html import (
    MAX_STRIP,
    Fact,
    Panel,
    Table,
    axes,
    number_text,
    page,
    player,
    seconds_text,
    section,
    stored_figure,
    strip,
    table,
)


def frames(t: int = 3, h: int = 5, w: int = 7) -> np.ndarray:
    return np.arange(t * h * w, dtype=np.uint8).reshape(t, h, w)


def test_page_loads_nothing_from_elsewhere():
    body = section("A scene", player([Panel("truth", frames()), Panel("codes", frames())]))
    text = page("Title", ["story"], [Fact("3 dB", "better")], [body])
    addresses = re.findall(r'(?:src|href|data-strip)="([^"]*)"', text)
    assert sum(a.startswith("data:") for a in addresses) == 2
    assert [a for a in addresses if not a.startswith("data:")] == ["#s1"]
    assert "{{" not in text
    assert "<strong>3 dB</strong>" in text


def test_text_is_escaped():
    text = page("<b>", ["&<u>"], [], [section("<i>", table(Table("c", ["<x>"], [["a<b"]])))])
    assert "&amp;&lt;u&gt;" in text
    assert "&lt;i&gt;</h2>" in text
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


def test_columns_of_formatted_numbers_are_aligned_too():
    text = table(
        Table("t", ["PSNR", "time", "light"], [["20.12 ± 0.50 †", "65 µs", "3.25 PPP"], ["failed", "–", "26 PPP"]])
    )
    assert text.count('class="number"') == 2 * 3
    assert "<td>26 PPP</td>" in text


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (6.502e-5, "6.502e-05"),
        (0.00065, "0.00065"),
        (0.35681, "0.3568"),
        (12.0, "12"),
        (1428.57, "1429"),
        (123456.7, "123457"),
        (0.0, "0"),
    ],
)
def test_numbers_have_four_digits(value, shown):
    assert number_text(value) == shown


def test_a_number_reads_back_as_itself_to_four_digits():
    rng = np.random.default_rng(0)
    values = 10 ** rng.uniform(-7, 10, 2000) * rng.choice([-1.0, 1.0], 2000)
    for value in (*values.tolist(), 1000.0, 1250.3, 2000.0, 9999.7, 1e4, 1e6):
        assert float(number_text(value)) == pytest.approx(value, rel=5.1e-4), value
    assert number_text(1250.3) == "1250"


@pytest.mark.parametrize(
    ("seconds", "shown"), [(6.502e-5, "65 µs"), (0.3568, "357 ms"), (2.1, "2.1 s"), (0.0, "0 s"), (None, None)]
)
def test_times_have_units(seconds, shown):
    assert seconds_text(seconds) == shown


def test_a_stored_figure_embeds_its_bytes():
    assert "data:image/png;base64,aGk=" in stored_figure(b"hi", "caption")


def test_figures_follow_the_colours_of_the_page():
    """No black or white is left in the SVG, its text is text, and a caption cannot break out of it."""
    drawing, save = axes("<x>", "y")
    drawing.plot([1, 2], [3, 4])
    drawing.set_xscale("log")
    text = save('a "caption" <b>')
    assert text.startswith("<figure><svg role=")
    assert "currentColor" in text
    assert "var(--mark)" in text
    assert not re.search(r"#000000|#ffffff|<metadata|<\?xml|<g id=", text)
    assert "&lt;x&gt;</text>" in text
    assert "<b>" not in text
    assert 'aria-label="a &#34;caption&#34; &lt;b&gt;"' in text


def test_a_player_states_scores_and_its_shape():
    text = player([Panel("truth", frames()), Panel("codes", frames(), "12.1 dB")], left=1)
    assert "<b>12.1 dB</b>" in text
    assert "--ratio: 1.4000" in text
    assert text.index('<option value="1" selected>') < text.index('<option value="0" selected>')
