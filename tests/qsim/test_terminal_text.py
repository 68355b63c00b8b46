"""No name or value of a file moves the terminal, hides a line or turns the direction of writing."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qsim.cli import demo, program
from qsim.cli.program import main
from qsim.terminal import printable


@given(st.text())
def test_a_printable_text_has_no_control_character(text: str):
    shown = printable(text)
    kept = {"\n", "\t"}
    assert not any((ord(c) < 32 and c not in kept) or 127 <= ord(c) < 160 or c in "\u202e\u2066\u200f" for c in shown)
    assert printable(shown) == shown
    if text.isascii() and text.isprintable():
        assert shown == text


def test_a_message_shows_the_escapes_of_a_name(capsys):
    assert main(["preview", "red\x1b[31m\x1b]0;title\x07\u202e.npy"]) == 2
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert r"red\x1b[31m\x1b]0;title\x07\u202e.npy" in said


NAME = "red\x1b[31m\x1b]0;title\x07\u202ex"


@pytest.mark.parametrize(
    "words", ["preview {}.npy --bits 3", "preview {}.npy --bits 3 --play --fps 99", "preview none{} -v", "demo {}"]
)
def test_no_command_prints_the_controls_of_a_name(words: str, tmp_path: Path, monkeypatch, capsys):
    """Names of arrays on a terminal without colours, in a traceback, and in the steps of a demo."""
    monkeypatch.chdir(tmp_path)

    def call(words: list[str], capture: bool) -> str:
        raise subprocess.CalledProcessError(2, words)

    monkeypatch.setattr(demo, "call", call)
    if not words.startswith("demo"):
        np.save(f"{NAME}.npy", np.ones((2, 6, 8), np.uint8))
    main([word.format(NAME) for word in words.split()])
    shown = capsys.readouterr()
    assert r"red\x1b[31m" in shown.out + shown.err
    assert not set(shown.out + shown.err) & {"\x1b", "\x07", "\u202e"}


def test_a_message_with_a_name_of_two_lines_is_one_line(capsys):
    for words in (["check", "a\nqsim: every file is whole"], ["a\n\tb"], ["check", "--a\nb"]):
        assert program.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("qsim")
