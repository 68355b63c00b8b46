"""The arrows between the rooms of the house: who may import whom, read from the source text."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted(p for package in ("qsim", "quiver", "scenes") for p in (ROOT / package).rglob("*.py"))


def imports(path: Path) -> set[str]:
    """Every module that a file imports, anywhere in it, as an absolute dotted name."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


def where(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_there_are_sources_to_check():
    assert len(SOURCES) > 30


@pytest.mark.parametrize("path", SOURCES, ids=where)
def test_arrows_point_one_way(path):
    name, used = where(path), roots(path)
    if name.startswith("qsim/"):
        assert "quiver" not in used, "qsim never imports quiver: write files and let quiver read them"
        assert "torch" not in used, "only quiver imports torch"
    if "mitsuba" in used:
        assert name in {"qsim/backend.py", "qsim/rendering/renderer.py"}, "only the backend and the renderer"
    if "drjit" in used:
        assert name in {
            "qsim/backend.py",
            "qsim/rendering/renderer.py",
            "qsim/sensor/compiled/kernel.py",
            "qsim/sensor/compiled/jit.py",
            "qsim/sensor/compiled/lookup.py",
        }
    if name.startswith("quiver/") and "qsim" in used:
        doors = name == "quiver/data/codes.py" or name.startswith("quiver/baselines/")
        assert doors or "qsim.files" in imports(path), "quiver reaches qsim through data.py and baselines/ only"
    if name.startswith("scenes/") and name not in {"scenes/contact_sheet.py"}:
        own = {n for n in imports(path) if n.startswith("qsim.")}
        assert all(n.startswith(("qsim.scene", "qsim.checks")) for n in own)


def test_the_checker_sees_relative_and_nested_imports(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    path = tmp_path / "qsim" / "bad.py"
    path.parent.mkdir()
    path.write_text("def f():\n    from quiver import model\n    from . import keys\n")
    assert roots(path) == {"quiver", "qsim"}
    assert "qsim.keys" in imports(path)


def test_importing_qsim_loads_nothing_heavy():
    """Quick to import means: none of the slow libraries, and none of ours that pull them in."""
    code = (
        "import qsim, qsim.keys, qsim.qis, qsim.codes, qsim.clip, qsim.optics, sys;"
        "print(sorted({'mitsuba','drjit','torch','matplotlib','skimage','trimesh','scipy.stats'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "[]"


def test_importing_quiver_loads_torch_only_when_needed():
    code = "import quiver, quiver.cli, sys; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "False"
