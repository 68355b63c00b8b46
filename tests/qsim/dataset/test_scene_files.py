"""Scene files of the user: every file that a scene reads is found; an edit before a resume is refused."""

import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from fakes import RECIPE, tree

from qsim import files, scenes
from qsim.dataset import job_runner, provenance, recipe, scene_files
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job

HERE = Options(workers=0)
ROOT = str(Path(__file__).parents[3])

SCENE = '''"""A scene that reads all kinds of things."""
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
import reads_helper
from reads_package.inner import SIZE
sys.path.remove(str(HERE))

from qsim import scenes

reads = ["numbers.txt", "data.csv", "meshes/*.obj", "seed0.bin", "seed1.bin"]
NUMBERS = (HERE / "numbers.txt").read_text()


def scene(seed=0, *, speed=1.0):
    open(HERE / f"seed{seed}.bin", "rb").close()
    (HERE / "written.log").write_text("not read")
    meshes = sorted((HERE / "meshes").glob("*.obj"))
    meshes[seed].read_bytes()
    import reads_late
    return scenes.load("fan", seed, speed)
'''


def write_scene(folder: Path) -> Path:
    """Write the scene file and the files that it reads."""
    for name in ("reads_package", "meshes", "unrelated"):
        (folder / name).mkdir(parents=True)
    (folder / "wheel.py").write_text(SCENE)
    (folder / "reads_helper.py").write_text(
        "from pathlib import Path\nDATA = (Path(__file__).parent / 'data.csv').read_text()\n"
    )
    (folder / "reads_late.py").write_text("LATE = 1\n")
    (folder / "reads_package" / "__init__.py").write_text("")
    (folder / "reads_package" / "inner.py").write_text("SIZE = 3\n")
    for name in ("numbers.txt", "data.csv", "seed0.bin", "seed1.bin", "meshes/a.obj", "meshes/b.obj"):
        (folder / name).write_text(name)
    for name in ("notes.txt", "meshes/notes.txt", "unrelated/other.py", "seed7.bin"):
        (folder / name).write_text(name)
    return folder / "wheel.py"


READ = {
    *("wheel.py", "reads_helper.py", "reads_late.py", "reads_package/__init__.py", "reads_package/inner.py"),
    *("numbers.txt", "data.csv", "seed0.bin", "seed1.bin", "meshes/a.obj", "meshes/b.obj"),
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for scenes; modules imported by other tests are removed."""
    monkeypatch.syspath_prepend(tmp_path / "scene")
    for name in [name for name in sys.modules if name.startswith("reads_")]:
        del sys.modules[name]
    return tmp_path / "scene"


def make(job: Job, path: Path) -> object:
    """Make a clip that lists the files of its scene, as a rendered one does."""
    _, read = job_runner.load_traced(job)
    return write_clip(path, frames=1, height=2, width=3, **vars(provenance.origin(job, read)))


def test_a_python_scene_names_all_that_it_declares_and_imports_every_time(place: Path):
    path = write_scene(place)
    for seed in (0, 1, 0):
        _, read = scene_files.load(str(path), seed)
        assert set(read) == {*READ, "meshes/*.obj"}
        assert all(files.sha256(place / name) == digest for name, digest in read.items() if "*" not in name)


def small_scene(folder: Path, line: str) -> Path:
    """Write a scene of one line beside a text."""
    folder.mkdir(exist_ok=True)
    (folder / "a.txt").write_text("1")
    (folder / "wheel.py").write_text(
        f"from qsim import scenes\n{line}\n\n\n"
        "def scene(seed=0, speed=1.0):\n    return scenes.load('fan', seed, speed)\n"
    )
    return folder / "wheel.py"


def test_files_elsewhere_are_declared_by_absolute_or_relative_names(tmp_path: Path):
    (tmp_path / "shared.txt").write_text("2")
    lines = {f"reads = ['a.txt', {str(tmp_path / 'shared.txt')!r}]": str(tmp_path / "shared.txt")}
    lines["reads = ('a.txt', '../shared.txt')"] = "../shared.txt"
    lines["reads: list[str] = ['a.txt', '../shared.txt']"] = "../shared.txt"
    for line, name in lines.items():
        path = small_scene(tmp_path / "scene", line)
        read = scene_files.load(path)[1]
        assert set(read) == {"wheel.py", "a.txt", name}
        assert scene_files.change(str(path), name, read[name]) is None
        assert "was changed" in scene_files.change(str(path), name, "0" * 64)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("reads = ['b.txt']", "reads names 'b.txt', and there is no such file beside it"),
        ("reads = ['*.obj']", "reads names '*.obj', and there is no such file beside it"),
        ("reads = [str(n) for n in range(3)]", "line 2: reads is a list of names, written out once"),
        ("reads = 'a.txt'", "line 2: reads is a list of names, written out once"),
        ("reads = ['a.txt']; reads += ['b.txt']", "line 2: reads is a list of names, written out once"),
        ("if True: reads = ['a.txt']", "line 2: reads is a list of names, written out once"),
        ("reads = others = ['a.txt']", "line 2: reads is a list of names, written out once"),
        ("reads: list[str]", "line 2: reads is a list of names, written out once"),
        ("reads = ['a.txt', 3]", "line 2: reads is a list of names, written out once"),
    ],
)
def test_a_wrong_declaration_is_refused(tmp_path: Path, line: str, told: str):
    with pytest.raises(ValueError, match=re.escape(told)):
        scene_files.load(small_scene(tmp_path / "scene", line))


def test_two_scenes_with_helpers_of_one_name_have_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The second scene imported the helper of the first, which stayed in memory."""
    for name, blades in (("one", 3), ("two", 5)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "reads_blades.py").write_text(f"BLADES = {blades}\n")
        (tmp_path / name / "wheel.py").write_text(
            "import sys\nfrom pathlib import Path\nsys.path.insert(0, str(Path(__file__).parent))\n"
            "import reads_blades\nsys.path.pop(0)\nfrom qsim import scenes\n\n\n"
            "def scene(seed=0, speed=1.0):\n    return scenes.load('fan', reads_blades.BLADES, speed)\n"
        )
        made, read = scene_files.load(tmp_path / name / "wheel.py")
        assert set(read) == {"wheel.py", "reads_blades.py"}
        assert made.to_dict() == scenes.load("fan", blades).to_dict()


def test_the_package_is_not_the_users_wherever_it_lies(monkeypatch):
    """A clone in /dev/shm took its own modules for files of the scene."""
    monkeypatch.setattr(scene_files, "_LEFT_OUT", ("/dev/shm/clone/qsim/",))
    counted = [scene_files._counts(Path("/dev/shm/clone") / name) for name in ("qsim/files.py", "mine/wheel.py")]
    assert counted == [False, True]


def test_families_of_the_library_read_nothing_and_folders_everything(tmp_path: Path):
    assert scene_files.load("fan")[1] == {}
    from PIL import Image

    (tmp_path / "things" / "below").mkdir(parents=True)
    Image.fromarray(np.full((4, 4, 3), 200, np.uint8)).save(tmp_path / "things" / "below" / "wood.png")
    assert set(scene_files.load(tmp_path / "things")[1]) == {"below/wood.png"}


def edit(file: Path, rng: random.Random) -> None:
    """Change a file at random and keep its size and times: setting the clock back hides nothing."""
    status = file.stat()
    content = bytearray(file.read_bytes())
    if content:
        content[rng.randrange(len(content))] ^= 1
        file.write_bytes(bytes(content))
    else:
        file.write_bytes(b"#")
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


def wanted(path: Path) -> recipe.Recipe:
    text = RECIPE.replace('"fan"', f'"{path.name}"')
    return recipe.parse(text, path.parent / "r.toml")


@pytest.mark.parametrize("name", sorted(READ))
def test_an_edit_of_any_file_read_is_refused_by_name(place: Path, tmp_path: Path, name: str):
    path = write_scene(place)
    folder = tmp_path / "d"
    rng = random.Random(name)
    found = wanted(path)
    own = only(found, "wheel")
    assert generate(own, folder, HERE, make=make).failed == {}
    before = tree(folder)
    for unrelated in ("notes.txt", "meshes/notes.txt", "unrelated/other.py", "seed7.bin", "written.log"):
        edit(place / unrelated, rng)
    assert generate(own, folder, HERE, make=make).made == 0
    (folder / "jobs" / "wheel_0001.json").unlink()  # so that a job is unfinished
    original = (place / name).read_bytes()
    edit(place / name, rng)
    again = only(wanted(path), "wheel")
    for options in (HERE, Options(workers=0, retry=True), Options(workers=0, repair=True)):
        with pytest.raises(ValueError, match=rf"{name} was changed since its clip wheel_000[01] was made"):
            generate(again, folder, options, make=make)
    (place / name).unlink()
    if name != "wheel.py":
        with pytest.raises(
            ValueError, match=rf"({name} is missing|other files match .*/meshes/\*\.obj) since its clip"
        ):
            generate(own, folder, HERE, make=make)
    (place / name).write_bytes(original)
    assert generate(own, folder, HERE, make=make).failed == {}
    assert tree(folder) == before


def only(found: recipe.Recipe, stem: str) -> recipe.Recipe:
    return recipe.Recipe(found.name, tuple(job for job in found.jobs if job.stem == stem), found.source)


def test_another_mesh_in_a_folder_that_is_listed_is_refused(place: Path, tmp_path: Path):
    path = write_scene(place)
    own = only(wanted(path), "wheel")
    generate(own, tmp_path / "d", HERE, make=make)
    (place / "meshes" / "aa.obj").write_text("a new one changes which mesh a seed picks")
    with pytest.raises(ValueError, match=r"other files match .*meshes/\*\.obj since its clip wheel_0000 was made"):
        generate(own, tmp_path / "d", HERE, make=make)


XML = """<scene version="3.0.0">
  <default name="kind" value="rough"/>
  <path value="assets"/>
  <include filename="parts/lights.xml"/>
  <shape type="ply"><string name="filename" value="mesh.ply"/>
    <bsdf type="diffuse"><texture type="bitmap">
      <string name="filename" value="tex/$kind.png"/>
    </texture></bsdf>
  </shape>
</scene>
"""


def test_an_xml_scene_names_meshes_bitmaps_and_includes(tmp_path: Path):
    names = ["parts/lights.xml", "parts/deep.xml", "assets/mesh.ply", "tex/rough.png", "parts/sky.exr", "unrelated.png"]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "s.xml").write_text(XML)
    (tmp_path / "parts" / "lights.xml").write_text(
        '<scene version="3.0.0"><include filename="parts/deep.xml"/><include filename="parts/lights.xml"/></scene>'
    )
    (tmp_path / "parts" / "deep.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    )
    found = {str(path.relative_to(tmp_path)) for path in scene_files.of_xml(tmp_path / "s.xml")}
    assert found == {"s.xml", *names} - {"unrelated.png"}


MOVED = """from pathlib import Path
from qsim import read_mitsuba

def scene(seed=0, *, speed=1.0):
    return read_mitsuba(Path(__file__).with_name("s.xml"))
"""
SMALL_XML = """<scene version="3.0.0">
  <sensor type="perspective"><film type="hdrfilm"/></sensor>
  <emitter type="constant"/>
  <shape type="obj"><string name="filename" value="m.obj"/></shape>
</scene>
"""


@pytest.mark.parametrize("name", ["s.xml", "moved.py"])
def test_choosing_an_engine_is_no_reading_of_the_scene(tmp_path: Path, name: str):
    """In a new process the first scene starts Mitsuba: it must name the same files as the second."""
    (tmp_path / "moved.py").write_text(MOVED)
    (tmp_path / "s.xml").write_text(SMALL_XML)
    (tmp_path / "m.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n")
    code = (
        "import sys; from qsim.dataset.scene_files import load\nfor _ in range(2): print(sorted(load(sys.argv[1])[1]))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / name)]
    made = subprocess.run(command, env=os.environ | {"PYTHONPATH": ROOT}, capture_output=True, text=True, check=True)
    expected = sorted({name, "s.xml", "m.obj"})
    assert made.stdout.splitlines() == [str(expected)] * 2


def test_folders_named_by_path_cost_no_more_than_their_number(tmp_path: Path):
    """Each <path> doubled the folders that were searched: twenty of them took a minute."""
    text = '<scene version="3.0.0">{}<shape type="ply"><string name="filename" value="mesh.ply"/></shape></scene>'
    (tmp_path / "mesh.ply").write_text("mesh")
    (tmp_path / "s.xml").write_text(text.format('<path value="."/><path value="./sub/.."/>' * 500))
    started = time.process_time()
    assert scene_files.of_xml(tmp_path / "s.xml") == {tmp_path / "s.xml", tmp_path / "mesh.ply"}
    once = time.process_time() - started
    (tmp_path / "s.xml").write_text(text.format('<path value="."/>'))
    started = time.process_time()
    scene_files.of_xml(tmp_path / "s.xml")
    assert once < 100 * (time.process_time() - started) + 0.5
    (tmp_path / "s.xml").write_text(text.format("".join(f'<path value="{i}"/>' for i in range(200))))
    with pytest.raises(ValueError, match=r"names more than 100 folders by <path>"):
        scene_files.of_xml(tmp_path / "s.xml")
