"""Tests tables: text is aligned, and Markdown keeps its columns for any cell."""

import pytest

from qsim.tables import markdown_table, text_table


def test_the_first_columns_are_aligned_left_and_the_others_right():
    rows = [("QIS", "3", "12.5"), ("CountingSPAD", "12", "")]
    assert text_table(rows, ("model", "bits", "dB")) == [
        "model         bits    dB",
        "QIS              3  12.5",
        "CountingSPAD    12",
    ]


def test_a_header_without_rows_is_a_table():
    assert text_table([], ("a", "b"), left=2, gap=" | ") == ["a | b"]


def test_a_bar_in_a_cell_starts_no_column():
    assert markdown_table([("a|b", "1")], ("name", "n")) == ["| name | n |", "|---|---|", "| a\\|b | 1 |"]


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="a row of 1 cells under a header of 2"):
        markdown_table([("a",)], ("a", "b"))
    with pytest.raises(ValueError, match="zip"):
        text_table([("a",)], ("a", "b"))


def test_a_cell_is_one_line():
    assert text_table([("a\nb\x1b", "1")], ("name", "n")) == ["name      n", "a\\nb\\x1b  1"]
    assert markdown_table([("a\nb", "1")], ("name", "n"))[2] == "| a\\nb | 1 |"
