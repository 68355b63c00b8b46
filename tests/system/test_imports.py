"""The rooms of the house: which may import which, and that no files import in a circle.

Every import counts, also those inside functions and under TYPE_CHECKING. They are read from the source text.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import qsim.sensor.devices

ROOT = Path(__file__).parents[2]
PACKAGES = ("qsim", "quiver", "scenes")

# Each room and the rooms that it may import. `qsim` and `quiver` alone are the ground floors: files in no room.
ROOMS: dict[str, set[str]] = {
    "qsim": set(),
    "qsim.optics": {"qsim"},
    "qsim.sensor": {"qsim"},
    "qsim.scene": {"qsim", "qsim.optics"},
    "qsim.clip": {"qsim", "qsim.optics"},
    "qsim.streams": {"qsim", "qsim.optics", "qsim.sensor", "qsim.clip"},
    "qsim.rendering": {"qsim", "qsim.optics", "qsim.scene", "qsim.clip", "qsim.streams"},
    "qsim.formats": {"qsim", "qsim.optics", "qsim.sensor", "qsim.clip", "qsim.streams", "qsim.scene"},
    "qsim.scenes": {"qsim", "qsim.optics", "qsim.scene", "qsim.rendering"},
    "qsim.dataset": {
        *("qsim", "qsim.optics", "qsim.sensor", "qsim.scene", "qsim.clip", "qsim.streams", "qsim.rendering"),
        *("qsim.scenes",),
    },
    "qsim.publishing": {"qsim", "qsim.optics", "qsim.sensor", "qsim.clip", "qsim.streams", "qsim.dataset"},
    "qsim.calibration": {"qsim", "qsim.sensor", "qsim.streams", "qsim.formats"},
    "qsim.studies": {
        *("qsim", "qsim.optics", "qsim.sensor", "qsim.scene", "qsim.clip", "qsim.streams", "qsim.rendering"),
        *("qsim.formats", "qsim.scenes", "qsim.dataset"),
    },
    "qsim.report": {"qsim", "qsim.optics", "qsim.sensor", "qsim.clip", "qsim.streams", "qsim.formats", "qsim.dataset"},
    "qsim.cli": {
        *("qsim", "qsim.optics", "qsim.sensor", "qsim.scene", "qsim.clip", "qsim.streams", "qsim.rendering"),
        *("qsim.formats", "qsim.scenes", "qsim.dataset", "qsim.calibration", "qsim.studies", "qsim.report"),
        *("qsim.publishing",),
    },
    "quiver": {"qsim"},
    "quiver.data": {
        *("qsim", "quiver", "qsim.optics", "qsim.sensor", "qsim.clip", "qsim.streams", "qsim.dataset"),
        *("qsim.formats", "qsim.publishing"),
    },
    "quiver.model": {"qsim", "quiver"},
    "quiver.baselines": {"qsim", "quiver", "qsim.sensor", "quiver.data"},
    "quiver.restoration": {"qsim", "quiver", "quiver.data", "quiver.model", "quiver.baselines"},
    "quiver.training": {"qsim", "quiver", "quiver.data", "quiver.model", "quiver.restoration", "quiver.evaluation"},
    "quiver.evaluation": {"qsim", "quiver", "quiver.data", "quiver.model", "quiver.baselines", "quiver.restoration"},
    "quiver.cli": {
        *("qsim", "qsim.cli", "quiver", "quiver.data", "quiver.model", "quiver.baselines", "quiver.restoration"),
        *("quiver.training", "quiver.evaluation"),
    },
}
DOORS = {  # who may import these libraries
    "mitsuba": ("qsim.rendering.",),
    "drjit": ("qsim.backend", "qsim.rendering.", "qsim.sensor.compiled."),
    "torch": ("quiver.",),
}

# Offenders on the day of the move. An entry leaves when its tie is cut; none is added.
STILL_FORBIDDEN: set[tuple[str, str]] = set()
STILL_IN_CIRCLES: set[str] = set()


def sources() -> list[Path]:
    return sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    """The dotted name of a module; a package's face has the package's name. The scene library is `qsim.scenes`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = ("qsim", *parts) if parts[0] == "scenes" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """The room of a module: a folder directly in qsim or quiver, or the ground floor."""
    parts = module.split(".")
    return ".".join(parts[:2]) if len(parts) > 1 and (ROOT / parts[0] / parts[1]).is_dir() else parts[0]


def asked(path: Path) -> Iterator[tuple[str, str]]:
    """(module, name) of every import of a file, name "" for `import module`; relative ones made absolute."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            yield from ((module, alias.name) for alias in node.names)


def homes() -> dict[str, dict[str, str]]:
    """For every face: the module that each name comes from, by its stub if it has one."""
    found = {}
    for path in sources():
        if path.name == "__init__.py":
            stub = path.with_suffix(".pyi")
            found[name_of(path)] = {name: module for module, name in asked(stub if stub.exists() else path) if name}
    return found


def graph() -> dict[str, set[str]]:
    """For every file but faces and __main__: the files that it imports; a face's name leads to its file."""
    modules = {name_of(p): p for p in sources()}
    faces = homes()

    def target(module: str, name: str) -> str | None:
        if f"{module}.{name}" in modules:
            return target(f"{module}.{name}", "")
        if module in faces and name in faces[module]:
            return target(faces[module][name], name)
        return module if module in modules else None

    files = {m: p for m, p in modules.items() if p.name not in ("__init__.py", "__main__.py")}
    found = {m: {target(*one) for one in asked(p)} for m, p in files.items()}
    return {m: {t for t in targets if t in files and t != m} for m, targets in found.items()}


def circles(arrows: dict[str, set[str]]) -> set[str]:
    """The nodes that can reach themselves."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        todo = list(arrows[start])
        while todo:
            node = todo.pop()
            if node not in seen:
                seen.add(node)
                todo += arrows.get(node, ())
        return seen

    return {node for node in arrows if node in reached(node)}


def test_the_scene_library_is_imported_under_one_name():
    """In a checkout qsim/scenes is a link to scenes/, so a user's own `scenes` is never imported, and none of ours."""
    assert (ROOT / "qsim" / "scenes").readlink() == Path("../scenes")
    assert not [name_of(p) for p in sources() if any(module.split(".")[0] == "scenes" for module, _ in asked(p))]


def test_there_are_sources_to_check():
    assert len(sources()) > 150
    assert sum(map(len, graph().values())) > 500


def test_every_room_is_in_the_table():
    assert {room_of(name_of(p)) for p in sources()} == set(ROOMS)


def test_the_table_of_rooms_has_no_circle():
    assert not circles(ROOMS)


def test_rooms_import_what_the_table_allows():
    arrows = {(room_of(a), room_of(b)) for a, targets in graph().items() for b in targets}
    forbidden = {(a, b) for a, b in arrows if a != b and b not in ROOMS[a]}
    assert forbidden == STILL_FORBIDDEN


def test_no_files_import_in_a_circle():
    assert circles(graph()) == STILL_IN_CIRCLES


@pytest.mark.parametrize("library", DOORS)
def test_heavy_libraries_stay_behind_their_doors(library):
    users = {name_of(p) for p in sources() if library in {module.split(".")[0] for module, _ in asked(p)}}
    assert users
    assert not {user for user in users if not user.startswith(DOORS[library])}


def test_no_module_is_named_like_a_function_of_its_face():
    for face, names in homes().items():
        modules = {p.stem for p in (ROOT / face.replace(".", "/")).iterdir()}
        assert not [name for name, home in names.items() if name in modules and home != face], face


def asked_for(tree: ast.AST, names: set[str]) -> Iterator[str]:
    """The classes of these names that `isinstance`, `issubclass` or a pattern of `match` asks for."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "issubclass"):
            found = {part.split(".")[-1] for part in re.findall(r"[\w.]+", ast.unparse(node.args[1]))}
            yield from found & names
        elif isinstance(node, ast.MatchClass):
            yield from {ast.unparse(node.cls).split(".")[-1]} & names


def test_no_room_asks_which_model_a_sensor_is():
    """A model states what it can do (qsim/sensor/sensor.py): a new one then works everywhere. `Sensor` is no model."""
    models = {"SPAD", *qsim.sensor.devices.MODELS}
    assert {"QIS", "BinarySPAD", "CountingSPAD", "SpikeCamera"} < models
    rooms = [p for p in sources() if room_of(name_of(p)) != "qsim.sensor"]
    asked_by = {name_of(p): list(asked_for(ast.parse(p.read_text(encoding="utf-8")), models)) for p in rooms}
    assert not {name: found for name, found in asked_by.items() if found}
    seen = ast.parse(
        "isinstance(a, QIS | b.SPAD)\nmatch a:\n    case SpikeCamera():\n        pass\nisinstance(a, Sensor)"
    )
    assert sorted(asked_for(seen, models)) == ["QIS", "SPAD", "SpikeCamera"]


def test_every_name_of_a_face_can_be_imported():
    faces = [name_of(p) for p in sources() if p.name == "__init__.py"]
    code = (
        "import importlib\n"
        f"for face in {faces!r}:\n"
        "    module = importlib.import_module(face)\n"
        "    for name in getattr(module, '__all__', ()):\n"
        "        getattr(module, name)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_the_checker_sees_relative_nested_and_indirect_imports(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    room = tmp_path / "qsim" / "room"
    room.mkdir(parents=True)
    (tmp_path / "qsim" / "__init__.py").write_text("from qsim.room.a import A\n")
    (room / "__init__.py").write_text("")
    (room / "a.py").write_text("def f():\n    from . import b\n")
    (room / "b.py").write_text("if TYPE_CHECKING:\n    from qsim import A\n")
    (room / "c.py").write_text("from qsim.room import b\nfrom quiver import model\n")
    assert graph() == {"qsim.room.a": {"qsim.room.b"}, "qsim.room.b": {"qsim.room.a"}, "qsim.room.c": {"qsim.room.b"}}
    assert circles(graph()) == {"qsim.room.a", "qsim.room.b"}
    assert ("quiver", "model") in set(asked(room / "c.py"))


def test_importing_qsim_loads_nothing_heavy():
    """Quick to import means: none of the slow libraries, and none of ours that import them."""
    code = (
        "import qsim, qsim.keys, qsim.sensor.qis, qsim.sensor.packing, qsim.streams.clip, qsim.optics.radiometry, sys;"
        "heavy = {'mitsuba','drjit','torch','matplotlib','skimage','trimesh','scipy.stats','jinja2'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "[]"


def test_importing_quiver_loads_torch_only_when_needed():
    code = "import quiver, quiver.cli.program, sys; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "False"


def test_programs_beside_the_packages_import_names_that_exist():
    """Imports inside functions fail only where the function runs: some of these programs run for hours."""
    programs = [path for folder in ("benchmarks", "docs") for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(programs) > 50
    for path in programs:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in ("qsim", "quiver"):
                module = importlib.import_module(str(node.module))
                for name in (alias.name for alias in node.names):
                    there = hasattr(module, name) or importlib.util.find_spec(f"{node.module}.{name}")
                    assert there, (path, node.module, name)
