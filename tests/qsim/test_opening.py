"""Only regular files are opened, and none behind a link out of the folder of its description."""

from __future__ import annotations

import os

import pytest

from qsim import opening


def test_what_is_no_regular_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "circle", "/dev/zero"):
        with pytest.raises(ValueError, match=rf"{path}: .*file is expected"):
            opening.opened(tmp_path / path)
    for name in ("missing", "pipe/a"):
        with pytest.raises(FileNotFoundError, match=rf"{name}: no such mesh"):
            opening.opened(tmp_path / name, "mesh")


def test_a_file_beside_its_description_is_no_link_out_of_the_folder(tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    (folder / "own").write_bytes(b"own")
    (folder / "inside").symlink_to("own")
    (folder / "out").symlink_to("../secret")
    (tmp_path / "link").symlink_to("clip")  # the folder itself may be a link
    assert opening.content(folder / "inside", beside=folder) == b"own"
    assert opening.content(tmp_path / "link" / "own", beside=tmp_path / "link") == b"own"
    with pytest.raises(ValueError, match=r"out: is a link out of .*clip; put the file itself there"):
        opening.content(folder / "out", beside=folder)
    assert opening.content(folder / "out") == b"secret"


def test_an_open_file_has_its_name(tmp_path):
    """Libraries ask for it."""
    (tmp_path / "a").write_bytes(b"abc")
    with opening.opened(tmp_path / "a", most=3) as file:
        assert file.name == str(tmp_path / "a")
        assert file.read() == b"abc"
