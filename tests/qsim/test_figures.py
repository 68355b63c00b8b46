"""Tests figures: the name gives the format, and other names are refused."""

from pathlib import Path

import pytest

from qsim.figures import figure_png, new_figure, write_figure


def test_a_figure_has_its_size_as_png():
    png = figure_png(new_figure(2, 1))
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    assert [int.from_bytes(png[i : i + 4], "big") for i in (16, 20)] == [240, 120]


@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("new/b.svg", b"<?xml"), ("c.PDF", b"%PDF")])
def test_the_name_chooses_the_format(tmp_path: Path, name: str, start: bytes):
    write_figure(new_figure(2, 1), tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(start)


def test_another_name_is_refused_before_anything_is_written(tmp_path: Path):
    with pytest.raises(ValueError, match=r"a\.jpg: a figure is a \.png, \.svg or \.pdf file"):
        write_figure(new_figure(2, 1), tmp_path / "new" / "a.jpg")
    assert not list(tmp_path.iterdir())
