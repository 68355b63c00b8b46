"""What a Mitsuba scene names is looked at before Mitsuba opens it: nothing waits, and nothing grows without a bound."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from qsim.rendering.mitsuba_files import check

DOUBLED = '<default name="v0" value="xx"/>' + "".join(
    f'<default name="v{i + 1}" value="$v{i}$v{i}"/>' for i in range(40)
)
LONG = f'<default name="a" value="{"x" * 20000}"/><string name="q" value="{"$a" * 20000}"/>'
SHAPE = '<shape type="obj"><string name="filename" value="{}"/></shape>'


def scene(path: Path, text: str) -> Path:
    path.write_text(f'<scene version="3.0.0">{text}</scene>')
    return path


@pytest.mark.parametrize("text", [DOUBLED + '<shape type="$v40"/>', LONG])
def test_parameters_that_grow_are_refused(text, tmp_path):
    """A few lines asked for two terabytes of memory."""
    with pytest.raises(ValueError, match=r"a\.xml: its parameters \(\$NAME\) grow to"):
        check(scene(tmp_path / "a.xml", text))


def test_includes_that_multiply_are_refused(tmp_path):
    for level in range(12):
        scene(tmp_path / f"{level}.xml", f'<include filename="{level + 1}.xml"/>' * 8)
    scene(tmp_path / "12.xml", "")
    with pytest.raises(ValueError, match=r"0\.xml: includes 7\.\d+e\+10 files"):
        check(tmp_path / "0.xml")
    with pytest.raises(ValueError, match="includes itself"):
        check(scene(tmp_path / "a.xml", '<include filename="a.xml"/>'))


@pytest.mark.parametrize(
    "text",
    [
        '<include filename="{}"/>',
        SHAPE,
        '<default name="f" value="{}"/>' + SHAPE.format("$f"),
        SHAPE.format("$f") + '<default name="f" value="$g"/><default name="g" value="{}"/>',
        '<include filename="names.xml"/>' + SHAPE.format("$named"),
    ],
)
@pytest.mark.parametrize("name", ["pipe.xml", "/dev/zero"])
def test_a_pipe_is_refused_however_it_is_named(text, name, tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    scene(tmp_path / "names.xml", f'<default name="named" value="{name}"/>')
    with pytest.raises(ValueError, match=f"{name}: is a folder, a pipe or a device"):
        check(scene(tmp_path / "a.xml", text.format(name)))


def test_plain_parameters_and_includes_pass(tmp_path):
    scene(tmp_path / "b.xml", '<default name="size" value="8"/>' * 100)
    text = '<default name="a" value="1.0"/><default name="b" value="$a"/><float name="x" value="$b"/>'
    check(scene(tmp_path / "a.xml", text * 3 + '<include filename="b.xml"/>' * 50 + '<path value="."/>' * 5000))
    check(scene(tmp_path / "a.xml", '<default name="f" value="$f"/>' + SHAPE.format("$f" * 3000)))
