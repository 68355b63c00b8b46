"""Recipes: their jobs, and every error with file and place."""

import json
import random
import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fakes import make
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import WRONG, at, attempt, places, replaced

from qsim import records
from qsim.cli.program import main
from qsim.dataset import job_runner, provenance, recipe
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe, parse
from qsim.dataset.recipe_file import RecipeFile
from qsim.optics.camera import Camera
from qsim.rendering.render_settings import RenderSettings
from qsim.scene.camera_path import write_camera_path
from qsim.scenes import RECIPES

HEAD = """[recipe]
name = "tiny"
frames = 3
height = 8
width = 10
frame_rate = 2000.0
"""
SCENES = """
[[scenes]]
family = "fan"
seeds = [0, 2]
speed = [1.0, 2.5]

[[scenes]]
family = "tumble"
first = 5
count = 2
split = "test"
frames = 4
"""
STREAMS = """
[[streams]]
sensor = "quiver-physical"
bits = [1, 3]
ppp = [0.5, 3.25]
"""


def test_a_recipe_becomes_jobs():
    found = parse(HEAD + SCENES + STREAMS)
    names = ["fan_0000", "fan_0000_x2.5", "fan_0002", "fan_0002_x2.5", "tumble_0005", "tumble_0006"]
    assert [job.name for job in found.jobs] == names
    assert [job.settings.frames for job in found.jobs] == [3, 3, 3, 3, 4, 4]
    assert found.splits == {"train": names[:4], "val": [], "test": names[4:]}
    streams = found.jobs[0].streams
    assert [(s.bits, s.ppp) for s in streams] == [(1, 0.5), (1, 3.25), (3, 0.5), (3, 3.25)]
    assert [s.stream_name for s in streams][3] == "quiver-physical_3bit_3.25ppp"
    assert found.jobs[1].scene == "fan:0"


def test_lux_and_light_as_it_is():
    text = (
        '[[streams]]\nsensor = "quiver-physical"\nlux = 1.5\n[[streams]]\nsensor = "quiver-physical"\nabsolute = true\n'
    )
    streams = parse(HEAD + SCENES + text).jobs[0].streams
    assert [(s.ppp, s.lux) for s in streams] == [(None, 1.5), (None, None)]
    assert [s.stream_name for s in streams] == ["quiver-physical_1.5lx", "quiver-physical_asis"]


def test_a_digest_changes_with_everything_that_decides_the_files():
    def digests(text: str) -> set[str]:
        return {job.digest for job in parse(text).jobs}

    base = HEAD + SCENES + STREAMS
    assert digests(base) == digests(base + "\n# a comment\n")
    for old, new in [("frames = 3", "frames = 5"), ("bits = [1, 3]", "bits = 3"), ("2000.0", "1000.0")]:
        assert old in base
        changed = digests(base.replace(old, new))
        assert len(changed - digests(base)) >= 4
    assert digests(base.replace('name = "tiny"\n', 'name = "tiny"\nseed = 1\n')).isdisjoint(digests(base))


def test_a_camera_path_is_read_beside_the_recipe_and_decides_the_files(tmp_path: Path):
    camera = Camera(2e-4, 2.8, 1e-5, 8, 10)
    write_camera_path(tmp_path / "path.json", camera, frames=2, frame_rate=9.0)
    text = HEAD.replace("width = 10", 'width = 10\ncamera_path = "path.json"') + SCENES
    (job, *_), (plain, *_) = (parse(each, tmp_path / "r.toml").jobs for each in (text, HEAD + SCENES))
    assert job.settings.camera_path == str(tmp_path / "path.json")
    assert plain.settings.camera_path is None
    before = job.digest
    assert before != plain.digest
    write_camera_path(tmp_path / "path.json", camera, frames=3, frame_rate=9.0, force=True)
    assert job.digest not in (before, plain.digest)
    (tmp_path / "moved").mkdir()
    (tmp_path / "path.json").rename(tmp_path / "moved" / "path.json")
    assert (
        parse(text, tmp_path / "moved" / "r.toml").jobs[0].digest
        == replace(job, settings=replace(job.settings, camera_path=str(tmp_path / "moved" / "path.json"))).digest
    )
    (tmp_path / "path.json").write_text('{"frames": []}')
    with pytest.raises(
        ValueError, match=r"r\.toml: scenes\[0\]: camera_path: .*path\.json: a path needs two or more frames"
    ):
        parse(text, tmp_path / "r.toml")


AGAIN = "[[scenes]]\nfamily = "
MISTAKES = [
    # (text in the good recipe, its replacement, the message after the file's name)
    ("frames = 3", "frame = 3", r"unknown key 'recipe.frame' \(did you mean 'frames'\?\)"),
    ("width = 10\n", "", "key 'recipe.width' is missing"),
    ("first = 5", "first = 2147483647", r"scenes\[1\]: seeds 2147483647 to 2147483648; the largest is 2\^31 - 1"),
    ("frame_rate = 2000.0", 'frame_rate = "2000 fps"', "recipe.frame_rate: expected a number from 1 to 1e.08, got '2"),
    ("height = 8", "height = true", "recipe.height: expected a whole number from 1 to 100000, got True"),
    ("width = 10", 'width = 10\nbands = "cmyk"', "recipe.bands: expected one of rgb, got 'cmyk'"),
    ("width = 10", 'width = 10\ncamera_path = "none.json"', r"scenes\[0\]: camera_path: .*none\.json"),
    ('name = "tiny"', 'name = "../tiny"', "recipe.name: expected a name of letters, digits"),
    ('"fan"', '"fann"', r"scenes\[0\]: unknown family 'fann' \(did you mean 'fan'\?\)"),
    ("seeds = [0, 2]", "seeds = [0, 0]", r"scenes\[0\]: seeds: 0 is listed twice"),
    (
        "seeds = [0, 2]",
        "seeds = []",
        r"scenes\[0\].seeds: expected a whole number .* or a range of seeds, .*, got \[\]",
    ),
    ("seeds = [0, 2]", 'seeds = "7..3"', r'scenes\[0\]: seeds: "7..3" is no range; give "FIRST..LAST"'),
    ("seeds = [0, 2]", 'seeds = "0-9"', r"scenes\[0\].seeds: expected .* a range of seeds, .* got '0-9'"),
    ("seeds = [0, 2]", 'seeds = "0..2147483648"', r"scenes\[0\]: seeds: .* at most 2147483647"),
    ("seeds = [0, 2]", "seeds = [0, -1]", r"scenes\[0\].seeds\[1\]: expected a whole number from 0 to 2147483647, got"),
    ("seeds = [0, 2]", "seeds = [0]\ncount = 3", r"scenes\[0\]: give either seeds or count"),
    ("speed = [1.0, 2.5]", "speed = inf", r"scenes\[0\].speed: expected a number .*, or a list of them, got inf"),
    ("speed = [1.0, 2.5]", "speed = [nan]", r"scenes\[0\].speed\[0\]: expected a number from 0.001 to 1000, got nan"),
    ('split = "test"', 'split = "tset"', r"scenes\[1\].split: expected one of train, val, test, got 'tset'"),
    ('sensor = "quiver-physical"', 'sensor = "quiver-phisical"', r"streams\[0\] of scenes\[0\]: .*quiver-physical"),
    ("bits = [1, 3]", "bits = [1, 17]", r"streams\[0\].bits\[1\]: expected a whole number from 1 to 16, got 17"),
    ("ppp = [0.5, 3.25]", "pp = [0.5, 3.25]", r"unknown key 'streams\[0\].pp' \(did you mean 'ppp'\?\)"),
    ("ppp = [0.5, 3.25]", "ppp = 1.0\nlux = 1.0", r"streams\[0\]: give one light level, .* ppp and lux given"),
    ("ppp = [0.5, 3.25]", "absolute = false", r"streams\[0\].absolute: expected one of true, got False"),
    ("ppp = [0.5, 3.25]", 'ppp = [1, 2]\nname = "x"', r"streams\[0\]: name: one name for 4 streams"),
    ("ppp = [0.5, 3.25]", "ppp = 1e9", r"streams\[0\].ppp: expected .* 1e.06, or a list of them, got 10"),
    ("ppp = [0.5, 3.25]", "ppp = 1\ngroup = true\nplanes = 10", "group sums .* planes, and planes says how many"),
    ("seeds = [0, 2]", "height = 90000\nwidth = 90000", r"scenes\[0\]: frames of 90000 x 90000 pixels; at most"),
    (
        "ppp = [0.5, 3.25]",
        "ppp = 1\ngroup = true",
        r"streams\[0\] of scenes\[0\]: .* group= is for a clocked SPAD .* a QIS",
    ),
    ("ppp = [0.5, 3.25]", "ppp = 1\nslices = 4", r"streams\[0\] of .*3 frames are too few for one exposure"),
    ('"quiver-physical"\nbits = [1, 3]', '"spad512s"\ngroup = true', "the bits of a code"),
    ('"quiver-physical"', '"spad512s"\ngroup = true', "3 frames are too few for one code of 7 planes"),
    ('split = "test"', f'split = "test"\n{AGAIN}"fan"', r"scenes\[2\]: the clip fan_0000 is listed twice"),
    ('split = "test"', f'split = "test"\n{AGAIN}"fan"\nseeds = "1..9"', r"scenes\[2\]: the clip fan_0002 is listed"),
    (
        'split = "test"',
        f'split = "val"\n{AGAIN}"tumble"\nseeds = [9, 6]\nspeed = 2',
        r"scenes\[2\]: scene tumble:6 is in",
    ),
    ('split = "test"', f'split = "test"\n{AGAIN}"tumble"', r"scenes\[2\]: family tumble is in the splits 'train' and"),
    ('split = "test"', f'split = "val"\n{AGAIN}"tumble"\nfirst = 5\nspeed = 2', r"scenes\[2\]: .*splits 'val' and"),
    ("ppp = [0.5, 3.25]", f"ppp = 3.25\n{STREAMS}", r"streams\[1\]: two \[\[streams"),
    ("[[streams]]", "[[stream]]", r"unknown key 'stream' \(did you mean 'streams'\?\)"),
]


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES, ids=[m[1].replace("\n", " ") for m in MISTAKES])
def test_each_mistake_is_named_with_file_and_place(tmp_path: Path, old: str, new: str, message: str):
    text = HEAD + SCENES + STREAMS
    assert text.count(old) >= 1
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}: .*{message}") as caught:
        recipe.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "[scenes.a]\nfamily = 'fan'\n", "recipe.toml: scenes: expected a list"),
        (HEAD + "[[scenes]\n", r"recipe\.toml:7: not valid TOML"),
        (HEAD + "frames = 5\n", r"recipe\.toml:7: not valid TOML"),
        ("", "key 'recipe' is missing"),
        ("recipe = 3", "recipe: expected a table of values, got 3"),
        (HEAD, r"no \[\[scenes\]\], nothing to render"),
        (HEAD + "[[scenes]]\nseeds = [1]\n", r"key 'scenes\[0\].family' is missing"),
        (HEAD + SCENES + SCENES, r"the clip fan_0000 is listed twice"),
        (HEAD + SCENES + "[[streams]]\nppp = 3\n", r"key 'streams\[0\].sensor' is missing"),
    ],
)
def test_recipes_without_sense(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        parse(text)


FULL = tomllib.loads(HEAD + SCENES + STREAMS)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(list(places(FULL))), st.sampled_from(WRONG))
def test_a_wrong_value_anywhere_is_refused_in_one_line_or_kept(place, wrong):
    found, refusal = attempt(lambda: records.convert(replaced(FULL, place, wrong), RecipeFile, "FILE"))
    if refusal:
        assert re.match(r"FILE: .*\b" + str(place[0]), refusal)
        assert "\n" not in refusal
    else:
        assert at(records.plain(found, complete=True), place) == wrong


def test_a_recipe_is_stored_as_it_was_written():
    found = records.convert(FULL, RecipeFile, "FILE")
    assert records.convert(records.plain(found), RecipeFile, "FILE") == found
    assert records.plain(found)["streams"] == FULL["streams"]


SPIKE = '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.6\ndark_current = 0.0\nthreshold = 9\n'
COUNTER = '[sensor]\nmodel = "CountingSPAD"\npde = 0.4\ndark_count_rate = 9.0\ndead_time = 1e-8\nbits = 4\n'


@pytest.mark.parametrize(
    ("render", "sensor", "stream", "message"),
    [
        ('bands = "rgb"', "spad512s", "", "has three bands and spad512s no colour filters"),
        ("", "spad512s", 'colour = "rggb"', "has one band, and the sensor has colour filters"),
        ("", COUNTER + '[colour]\nmask = ["RG"]\n', "", "has one band, and the sensor has colour filters"),
        ("", SPIKE, "exposures = [1.0, 0.5]", "exposures: .* integrates without a pause"),
        ("", SPIKE + "[defects]\nprnu = 0.1\n", "", "defects of spike cameras are not modelled"),
        ("", COUNTER, "slices = 2\nexposures = [1.0, 0.5]", "exposures: slices of a counting pixel need"),
        (
            "",
            COUNTER + "[defects]\nafterpulse = 0.1\nafterpulse_delay = 1e-7\n",
            "exposures = [0.5]",
            "exposures: afterpulses and carried dead",
        ),
        ("", "quiver-physical", "follow = true", "follow= is for the photons of a CountingSPAD, this is a QIS"),
        ("shutter = 0.5", "quiver-physical", "row_delay = 1e-6", "rows .* need a clip whose shutter is open all the"),
        ("shutter = 0.5", "quiver-physical", "slices = 2", "slices of one exposure need a clip whose shutter is open"),
        ("", "quiver-physical", "slices = 4\nrow_delay = 1e-6", "4 frames are too few for one code, whose last row"),
        ("", COUNTER + "[defects]\ndark_map = 'map.npy'\n", "", "map.npy"),
    ],
)
def test_streams_that_could_not_be_drawn_fail_before_rendering(tmp_path, render, sensor, stream, message):
    """Some of these sentences came only after a clip had been rendered."""
    if sensor.startswith("[sensor]"):
        (tmp_path / "s.toml").write_text(sensor)
        sensor = "s.toml"
    head = f'[recipe]\nname = "t"\nframes = 4\nheight = 7\nwidth = 9\n{render}\n[[scenes]]\nfamily = "fan"\n'
    path = tmp_path / "r.toml"
    path.write_text(f'{head}[[streams]]\nsensor = "{sensor}"\nppp = 3.0\n{stream}\n')
    with pytest.raises(ValueError, match=message) as caught:
        recipe.load(path)
    assert str(caught.value).startswith(f"{path}: streams[0] of scenes[0]: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("family", ["./things", "room.xml"])
def test_colour_streams_of_scenes_that_cannot_state_bands_fail_before_rendering(tmp_path: Path, family: str):
    """Every clip was rendered, and then its job failed; only a .py scene may state bands."""
    (tmp_path / "things").mkdir()
    (tmp_path / "room.xml").touch()
    (tmp_path / "own.py").touch()
    stream = '[[streams]]\nsensor = "quiver-physical"\nppp = 3.0\ncolour = "rggb"\n'
    path = tmp_path / "r.toml"
    path.write_text(f'{HEAD}[[scenes]]\nfamily = "{family}"\n{stream}')
    with pytest.raises(ValueError, match="has one band, and the sensor has colour filters"):
        recipe.load(path)
    path.write_text(f'{HEAD}[[scenes]]\nfamily = "own.py"\n{stream}')
    assert recipe.load(path).jobs


@pytest.mark.parametrize("unit", ["ppp = 3.0", "lux = 3.0", "absolute = true"])
def test_streams_are_checked_without_their_light(unit):
    """A recipe with every unit of light is accepted."""
    stream = f'[[streams]]\nsensor = "spad512s"\nbits = 1\n{unit}\n'
    assert parse(HEAD + SCENES + stream).jobs[0].streams


def test_a_sensor_whose_name_holds_a_dot_keeps_it():
    stream = '[[streams]]\nsensor = "cmos-5.1e"\nbits = 10\nppp = 3.25\n'
    assert parse(HEAD + SCENES + stream).jobs[0].streams[0].stream_name == "cmos-5.1e_10bit_3.25ppp"


def test_splits_are_by_scene_whatever_the_speed():
    text = HEAD + "".join(
        f'[[scenes]]\nfamily = "fan"\nseeds = [0]\nspeed = {speed}\nsplit = "{split}"\n'
        for speed, split in [(1.0, "train"), (2.0, "val")]
    )
    with pytest.raises(ValueError, match="scene fan:0 is in the splits 'train' and 'val'"):
        parse(text)


def test_training_never_sees_a_family_of_the_test_split():
    text = HEAD + '[[scenes]]\nfamily = "fan"\n[[scenes]]\nfamily = "fan"\nfirst = 9\nsplit = "{}"\n'
    with pytest.raises(ValueError, match="family fan is in the splits 'train' and 'test'"):
        parse(text.format("test"))
    assert isinstance(parse(text.format("val")), Recipe)


def test_files_that_are_no_recipes(tmp_path: Path):
    with pytest.raises(
        FileNotFoundError, match=r"no such recipe; give a \.toml file, or one of bitdepth, bracketing, challenge, "
    ):
        recipe.load(tmp_path / "none.toml")
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not a text file"):
        recipe.load(path)


def test_a_scene_file_beside_the_recipe(tmp_path: Path):
    path = tmp_path / "own.toml"
    path.write_text(HEAD + '[[scenes]]\nfamily = "mine.py"\n')
    with pytest.raises(ValueError, match=r"own\.toml: scenes\[0\]: family: no such scene file"):
        recipe.load(path)
    (tmp_path / "mine.py").write_text("")
    job = recipe.load(path).jobs[0]
    assert job.name == "mine_0000"
    assert Path(job.family).is_absolute()


def test_own_files_decide_by_content_not_by_place(tmp_path: Path):
    """A scene file, a scene's folder, a sensor file: an edit makes another job, a move does not."""
    sensor = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 2\nread_noise = 0.2\nbits = 3\n'
    text = HEAD + '[[scenes]]\nfamily = "./{0}"\n[[streams]]\nsensor = "s.toml"\nbits = 3\nppp = 3.25\n'

    def digest(folder: str, family: str, scene: str, sensor: str = sensor) -> str:
        place = tmp_path / folder
        (place / "things").mkdir(parents=True, exist_ok=True)
        for name, content in (("scene.py", scene), ("things/a.obj", scene), ("s.toml", sensor)):
            (place / name).write_text(content)
        return recipe.parse(text.format(family), place / "r.toml").jobs[0].digest

    for family in ("scene.py", "things"):
        first = digest("a", family, "# one")
        assert digest("b", family, "# one") == first
        assert digest("a", family, "# two") != first
        assert digest("a", family, "# one", sensor + "# edited\n") != first
        assert digest("a", family, "# one") == first


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[3] / "scenes").glob("*.toml")), ids=lambda p: p.stem)
def test_the_recipes_of_the_library_are_valid(path: Path):
    assert recipe.load(path).jobs


def test_the_large_recipe_is_what_it_says():
    """280 clips of 114 scenes, 249 and 31, 512 x 1024, 2000 fps, shutter 0; no scene or test family shared."""
    wanted = recipe.load(Path(__file__).parents[3] / "scenes" / "i2_2000fps.toml").jobs
    assert len(wanted) == 280
    assert len({job.scene for job in wanted}) == 114
    count = {split: sum(job.split == split for job in wanted) for split in recipe.SPLITS}
    assert count == {"train": 249, "val": 0, "test": 31}
    render = {(s.height, s.width, s.frame_rate, s.shutter) for s in (job.settings for job in wanted)}
    assert render == {(512, 1024, 2000.0, 0.0)}
    families = {split: {job.family for job in wanted if job.split == split} for split in ("train", "test")}
    assert families["train"].isdisjoint(families["test"])


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((Path(__file__).parents[3] / "scenes").glob("*.toml")), ids=lambda p: p.stem)
def test_no_mesh_or_texture_of_a_test_scene_is_in_training(path: Path):
    """By content, not by name: SHA-256 of every picture and of all vertices, and photographs in any range."""
    found: dict[str, set[str]] = {split: set() for split in recipe.SPLITS}
    scenes = {job.scene: job for job in recipe.load(path).jobs}
    for job in scenes.values():
        scene = job_runner.load_scene(job)
        found[job.split] |= {*provenance.assets(scene.to_dict()), *provenance.photographs(scene)}
    for split in {job.split for job in scenes.values()} - {"val"}:  # domain.toml has test scenes only
        assert {asset.split()[0] for asset in found[split]} >= {"mesh", "texture"}
    assert found["test"].isdisjoint(found["train"] | found["val"])


SHARED = (  # a checkerboard and stripes of the room, which docs/restorer.md names
    "texture 74e5ce9c0a7645eb117a27b3158191c5bc400f0723a74e9729beb15556ee74ca",
    "texture d93217352a774dbc110685012c94383e15c6bf500e8d0d78d5667c855c67b910",
)


@pytest.mark.slow
@pytest.mark.parametrize(("test", "shared"), [("restorer_test", set(SHARED)), ("restorer_street", set())])
def test_the_clips_that_test_restorers_show_nothing_of_their_training(test, shared):
    """By content: no picture and no photograph is in restorer.toml or restorer_val.toml, but two that a page names."""
    found = []
    for name in (test, "restorer_val", "restorer"):
        jobs = {job.scene: job for job in recipe.load(Path(__file__).parents[3] / "scenes" / f"{name}.toml").jobs}
        scenes = [job_runner.load_scene(job) for job in jobs.values()]
        shown = {asset for s in scenes for asset in (*provenance.assets(s.to_dict()), *provenance.photographs(s))}
        found.append({asset for asset in shown if not asset.startswith("mesh")})
    assert found[0]
    assert found[0] & (found[1] | found[2]) == shared


def calls(action: Callable[[], object]) -> int:
    """Return the number of function calls, ours and built in, of an action."""
    count = 0

    def see(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(see)
    try:
        action()
    finally:
        sys.setprofile(None)
    return count


@pytest.mark.parametrize("kind", ["scenes", "streams", "seeds"])
def test_the_work_of_reading_a_recipe_is_linear(kind: str):
    """Four times as many sections or seeds: at most five times the calls. It was sixteen times for sections."""

    def text(n: int) -> str:
        scenes = [f'[[scenes]]\nfamily = "fan"\nseeds = [{i}]\n' for i in range(n if kind == "scenes" else 1)]
        if kind == "seeds":
            scenes = [f'[[scenes]]\nfamily = "fan"\nseeds = {list(range(n))}\n']
        streams = [
            f'[[streams]]\nsensor = "quiver-physical"\nbits = 3\nppp = {i + 1}\n'
            for i in range(n if kind == "streams" else 1)
        ]
        return HEAD + "".join(scenes + streams)

    parse(text(2))  # imports
    assert calls(lambda: parse(text(200))) < 5 * calls(lambda: parse(text(50)))


def accepted_by_the_jobs(stem: str, folder: Path) -> bool:
    """Return whether a job with such a name makes its clip, writes its record, and removes leftovers."""
    found = RenderSettings(1, 2, 3, 2000.0)
    job = Job(f"{stem}.py", 0, 0.001, "train", found, 0, ())
    for name in ("jobs", "failed", "clips", "logs", "locks", "work"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    try:
        return job_runner.run_job(job, folder, make).state == "done"
    except OSError:  # the file system refuses the name
        return False


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_scene_file_is_accepted_exactly_when_its_jobs_are(tmp_path: Path, count: int):
    """Random names of scene files: the recipe refuses, with its line, exactly those with which a job fails."""
    rng = random.Random(1)
    alphabet = "ab0_-. \u00fc\n\"'*[\\\t$"
    names = ["a b", "\u00fc", "__init__", "-x", "", "a" * 180, "a.tmp-1", "x.part", ".hidden", "CON"]
    names += ["".join(rng.choices(alphabet, k=rng.randrange(1, 6))) for _ in range(count)]
    names += ["".join(rng.choices("ab.-_", k=rng.randrange(1, 6))) for _ in range(count)]
    verdicts = set()
    for n, stem in enumerate(dict.fromkeys(names)):
        folder = tmp_path / str(n)
        folder.mkdir()
        (folder / f"{stem}.py").touch()
        path = folder / "r.toml"
        path.write_text(HEAD + "[[scenes]]\nfamily = " + json.dumps(f"{stem}.py", ensure_ascii=False))
        expected = accepted_by_the_jobs(Path(f"{stem}.py").stem, tmp_path / "jobs")
        if expected:
            recipe.load(path)
        else:
            with pytest.raises(
                ValueError, match=r"r\.toml: scenes\[0\]\S* (family: clips are named after the scene|expected a text)"
            ):
                recipe.load(path)
        verdicts.add(expected)
    assert verdicts == {True, False}
    long = tmp_path / ("a" * 181 + ".py")
    long.touch()
    (tmp_path / "r.toml").write_text(HEAD + f'[[scenes]]\nfamily = "{long.name}"\n')
    with pytest.raises(ValueError, match=r"r\.toml: scenes\[0\]: .* has 181 characters; at most 180"):
        recipe.load(tmp_path / "r.toml")


@pytest.mark.parametrize("name", RECIPES)
def test_a_shipped_recipe_is_found_by_its_name_unless_a_file_has_it(name: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert recipe.load(name).name == name
    assert recipe.text_of(name) == (RECIPES[name], RECIPES[name].read_text())
    (tmp_path / name).write_text(HEAD)
    assert recipe.text_of(name)[1].startswith(HEAD[:8])


def test_a_misspelt_recipe_is_suggested():
    with pytest.raises(FileNotFoundError, match=r"startr: no such recipe \(did you mean 'starter'\?\)"):
        recipe.load("startr")


@pytest.mark.parametrize("name", RECIPES)
def test_the_printed_text_of_a_shipped_recipe_is_a_recipe_elsewhere(name: str, tmp_path: Path, capsys):
    """Sensor files beside the shipped recipe were looked up beside the copy."""
    assert main(["recipes", "--print", name]) == 0
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    assert len(recipe.load(tmp_path / "mine.toml").jobs) == len(recipe.load(name).jobs)
