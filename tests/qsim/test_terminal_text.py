"""No name or value of a file moves the terminal, hides a line or turns the direction of writing."""

from hypothesis import given
from hypothesis import strategies as st

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
