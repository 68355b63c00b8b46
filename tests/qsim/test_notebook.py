"""Functions show a bar in a notebook, and nothing in a program."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from clips import write_clip

from qsim import notebook
from qsim.publishing import publish


@pytest.fixture
def kernel(monkeypatch):
    """IPython as in the kernel of a notebook."""
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setattr(notebook, "SHOWN_AFTER", 0)
    return shell


def test_sensing_and_publishing_show_bars_in_a_notebook(tmp_path, kernel, capsys):
    clip = write_clip(tmp_path / "clip", frames=4, height=12, width=16)
    clip.sense("quiver-physical", ppp=3)
    assert "4/4" in capsys.readouterr().out
    publish(clip.path, tmp_path / "out")
    assert "1/1" in capsys.readouterr().out


def test_a_program_and_a_terminal_show_none(tmp_path, kernel, capsys, monkeypatch):
    clip = write_clip(tmp_path / "clip", frames=4, height=12, width=16)
    kernel.kernel = None  # IPython in a terminal
    clip.sense("quiver-physical", ppp=3)
    monkeypatch.delitem(sys.modules, "IPython")
    clip.sense("quiver-physical", ppp=4)
    assert capsys.readouterr().out == ""


def test_what_is_given_is_reported_to(kernel, capsys):
    heard = []
    with notebook.reporting(lambda *said: heard.append(said), "x") as progress:
        progress(1, 2)
    assert heard == [(1, 2)]
    assert capsys.readouterr().out == ""
