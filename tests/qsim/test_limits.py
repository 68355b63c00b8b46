"""The table of limits is the one on its page, and its numbers are those that act."""

from __future__ import annotations

from pathlib import Path

import pytest

from qsim import files, limits, opening

PAGE = Path(__file__).parents[2] / "docs/limits.md"


def test_the_page_is_the_table():
    shown = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    assert shown == limits.rows()


def test_every_limit_is_a_number_of_the_table():
    numbers = [value for name, value in vars(limits).items() if name.isupper() and isinstance(value, int)]
    assert numbers == [one.most for one in limits.TABLE]


def test_a_description_above_its_limit_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_text('{"a": 1}')
    assert files.read_json(path) == {"a": 1}
    with pytest.raises(ValueError, match=r"a\.json: has 8 bytes; at most 7 are read"):
        opening.content(path, most=7)
    with open(path, "r+b") as file:
        file.truncate(limits.TEXT + 1)
    with pytest.raises(ValueError, match=f"at most {limits.TEXT} are read"):
        files.read_json(path)
