"""The wheel holds every room, and its commands work from an installation alone, outside the source tree."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).parents[2]
SOURCES = ("qsim", "quiver", "scenes")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


def run(*command: str | Path, cwd: Path, **variables: str) -> str:
    """The output of a command; a failure shows it."""
    inherited = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONWARNINGS")}
    found = subprocess.run(
        command,
        cwd=cwd,
        env=inherited | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout
    return found.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the source tree, built from a copy: building leaves files beside the sources."""
    folder = tmp_path_factory.mktemp("build")
    copy = folder / "copy"
    copy.mkdir()
    for name in SOURCES:
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    run(*PIP, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder, copy, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds nothing but the installed wheel."""
    target = tmp_path_factory.mktemp("installed")
    run(*PIP, "install", "--no-deps", "--no-index", "--target", target, wheel, cwd=target)
    return target


def missing(wheel: Path, tree: Path) -> set[str]:
    """Files of the packages in `tree` that the wheel lacks; the pages of a folder (README.md) stay behind."""
    found = {p.relative_to(tree).as_posix() for name in SOURCES for p in (tree / name).rglob("*") if p.is_file()}
    found = {f"qsim/{name}" if name.startswith("scenes/") else name for name in found}
    wanted = {name for name in found if "__pycache__" not in name and not name.endswith("README.md")}
    with zipfile.ZipFile(wheel) as archive:
        return wanted - set(archive.namelist())


def test_the_wheel_holds_every_file_of_every_room(wheel: Path):
    assert not missing(wheel, ROOT)


def test_a_missing_room_would_be_noticed(wheel: Path, tmp_path: Path):
    (tmp_path / "qsim" / "attic").mkdir(parents=True)
    (tmp_path / "qsim" / "attic" / "__init__.py").touch()
    assert missing(wheel, tmp_path) == {"qsim/attic/__init__.py"}


def test_the_wheel_takes_no_other_top_level_name(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"qsim", "quiver"}


@pytest.mark.parametrize("place", ["wheel", "checkout"])
def test_scenes_of_a_user_and_of_this_project_do_not_meet(installed: Path, tmp_path: Path, place: str):
    """A user's package, module and folder called `scenes` are found first, and both programs still work."""
    ours = installed if place == "wheel" else ROOT
    mine = tmp_path / "scenes"
    mine.mkdir()
    (mine / "__init__.py").write_text("MINE = 1\n")
    (mine / "fan.py").write_text("raise RuntimeError('the wrong fan')\n")
    (mine / "own.py").write_text("import scenes\nfrom qsim.scenes.fan import scene\nassert scenes.MINE\n")
    code = (
        "import scenes, qsim, qsim.cli, qsim.scenes\n"
        "assert scenes.MINE and 'fan' in qsim.scenes.FAMILIES\n"
        f"assert qsim.scenes.__file__.startswith({str(ours)!r}), qsim.scenes.__file__\n"
        "from qsim.dataset import scene_files\n"
        "a, b = (scene_files.load(name)[0].to_dict() for name in ('fan', 'scenes/own.py'))\n"
        "assert a == b\n"
        "raise SystemExit(qsim.cli.main(['plan', '--help']))"
    )
    run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=f"{tmp_path}{os.pathsep}{ours}")


def test_an_installation_renders_senses_and_restores(installed: Path, tmp_path: Path):
    """Every file that these commands import must come from the installation, not from this tree."""
    lines = (
        "qsim doctor",
        "qsim render fan -o fan --height 16 --width 24 --frames 11 --psnr 20",
        "qsim sense fan --ppp 3.25 --bits 3",
        "quiver restore fan -o fan.npy",
    )
    code = (
        "import sys, qsim.cli, quiver.cli\n"
        "mains = {'qsim': qsim.cli.main, 'quiver': quiver.cli.main}\n"
        f"for program, *words in map(str.split, {lines!r}):\n"
        "    assert mains[program](words) == 0, words\n"
        "names = [n for n in sys.modules if n.split('.')[0] in ('qsim', 'quiver')]\n"
        "files = [getattr(sys.modules[n], '__file__', None) for n in names]\n"
        f"strange = [f for f in files if f and not f.startswith({str(installed)!r})]\n"
        "sys.exit(str(strange) if strange else 0)"
    )
    said = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(installed))
    assert "variant" in said
    assert (tmp_path / "fan.npy").is_file()


def test_the_commands_are_installed(installed: Path, tmp_path: Path):
    for program in ("qsim", "quiver"):
        said = run(sys.executable, installed / "bin" / program, "--version", cwd=tmp_path, PYTHONPATH=str(installed))
        assert said.startswith(f"{program} ")


def test_pinned_packages_install_on_the_oldest_python():
    """Debian 12 has Python 3.11.2: a pin that asks for 3.11.5 made every installation there fail."""
    oldest = re.search(r'requires-python = ">=([0-9.]+)', (ROOT / "pyproject.toml").read_text())[1]
    pins = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    asked = {}
    for name in pins:
        try:
            asked[name] = metadata(name).get("Requires-Python") or ""
        except PackageNotFoundError:
            continue
    assert len(asked) > len(pins) / 2
    newer = {name: text for name, text in asked.items() if f"{oldest}.0" not in SpecifierSet(text)}
    assert not newer, "pin a version that installs there"
