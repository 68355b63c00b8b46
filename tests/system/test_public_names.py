"""Tests the public names that other programs use, and the version, which is written once."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import qsim
import quiver

ROOT = Path(__file__).parents[2]
RELIED_ON = (
    *("QIS", "BinarySPAD", "CountingSPAD", "Sensor", "Key", "Camera", "Scene", "Clip", "ClipWriter", "Stream"),
    *(
        "Dataset",
        "pack",
        "unpack",
        "expected_photons",
        "render_clip",
        "Budget",
        "choose_budget",
        "load_sensor",
        "sense",
    ),
    *("Sensing", "Renderer", "replay", "calibrate_qis", "calibrate_spad", "read_mitsuba"),
)


@pytest.mark.parametrize("name", RELIED_ON)
def test_public_names_of_qsim(name: str):
    assert name in qsim.__all__
    assert callable(getattr(qsim, name))
    assert name in dir(qsim)


@pytest.mark.parametrize("name", ["QUIVER", "from_published", "restore"])
def test_public_names_of_quiver(name: str):
    assert name in quiver.__all__
    assert callable(getattr(quiver, name))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'qsim' has no attribute 'Nothing'"):
        _ = qsim.Nothing


def test_the_version_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert qsim.__version__ == project["version"]


def test_the_citation_has_the_version_and_the_authors_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    assert f"version: {project['version']}" in lines
    assert [f'  - name: "{author["name"]}"' for author in project["authors"]] == [x for x in lines if "name:" in x]


def test_the_version_of_a_source_tree_without_installation_is_read_from_it():
    code = (
        "from importlib import metadata\n"
        "def missing(name): raise metadata.PackageNotFoundError(name)\n"
        "metadata.version = missing\n"
        "import qsim; print(qsim.__version__)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == qsim.__version__


@pytest.mark.parametrize("name", ["qsim.optics.RGB", "qsim.sensor.devices.load", "quiver.data.codes", "quiver.threads"])
def test_modules_are_imported_by_their_dotted_names(name: str):
    """Pages name them so; without another import before they were no attributes."""
    program = f"import {name.partition('.')[0]}; print({name})"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout
    with pytest.raises(AttributeError, match="module 'qsim' has no attribute 'nothing'"):
        _ = qsim.nothing
