"""File names with other letters than ASCII, in a locale without them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from qsim.files import native

ROOT = Path(__file__).parents[2]
CODE = """
import pathlib, sys
import numpy as np
import OpenEXR
from qsim.files import native
from qsim.rendering import mitsuba_xml
from qsim.scene.image_files import read_hdr

assert sys.getfilesystemencoding() == "ascii"
(folder,) = pathlib.Path("inputs").iterdir()
scene = mitsuba_xml.read_mitsuba(folder / "scene.xml")
bands = {name: np.ones((2, 3), np.float32) for name in "RGB"}
OpenEXR.File({"type": OpenEXR.scanlineimage}, bands).write(native(folder / "light.exr"))
assert read_hdr(folder / "light.exr").shape[:2] == (2, 3)
"""
SCENE = """<scene version="3.0.0"><emitter type="constant"/><shape type="sphere" id="ball"/>
<sensor type="perspective"><float name="fov" value="40"/></sensor></scene>"""


def test_scenes_and_pictures_are_read_by_libraries_that_take_utf8(tmp_path):
    folder = tmp_path / "inputs" / "sćene é"
    folder.mkdir(parents=True)
    (folder / "scene.xml").write_text(SCENE)
    variables = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", CODE]
    ended = subprocess.run(words, cwd=tmp_path, env=variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_a_name_that_is_no_text_is_named():
    assert native("é") == "é"
    with pytest.raises(ValueError, match="the name is not UTF-8, so no library reads it; rename it"):
        native(os.fsdecode(b"\xff.xml"))
