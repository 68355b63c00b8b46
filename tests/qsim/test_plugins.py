"""Sensors and methods of others: named by file or entry point, stored, opened elsewhere, refused in one sentence."""

import json
import os
import pickle
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim import plugins
from qsim.cli import main
from qsim.dataset import recipe
from qsim.keys import Key
from qsim.sensor import devices
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing
from qsim.streams.stream import Stream
from quiver.restoration.restorers import restorer

PACKAGE = Path(__file__).parents[2] / "docs" / "examples" / "own_parts"
SENSORS = PACKAGE / "own_parts" / "sensors.py"
METHODS = PACKAGE / "own_parts" / "methods.py"


@pytest.fixture(autouse=True)
def nothing_named(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Files that a test names are forgotten after it."""
    monkeypatch.setenv(plugins.VARIABLE, "")
    yield
    for name in [name for name in sys.modules if name.startswith(("qsim_plugin_", "own_parts"))]:
        del sys.modules[name]
    plugins._entries.cache_clear()
    plugins._source_of_module.cache_clear()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example package as if it were installed: its entry points are those of its pyproject.toml."""
    about = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    info = tmp_path / "site" / "own_parts-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {about['name']}\nVersion: {about['version']}\n")
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())])
        for group, entries in about["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))
    for folder in (tmp_path / "site", PACKAGE):
        monkeypatch.syspath_prepend(folder)
    plugins._entries.cache_clear()


def clip_in(folder: Path) -> Clip:
    return write_clip(folder / "clip", frames=4, height=12, width=16)


@pytest.mark.parametrize("kind", ["Trigger", "Noisy"])
def test_a_stream_of_a_file_names_it_and_opens_where_it_is_named(tmp_path: Path, kind: str, monkeypatch):
    clip = clip_in(tmp_path)
    assert main(["sense", str(clip.path), "--sensor", f"{SENSORS}:{kind}", "--ppp", "4", "-o", "s", "-q"]) == 0
    about = json.loads((clip.path / "streams" / "s.json").read_text())["sensor"]["plugin"]
    assert about == {"module": "sensors.py", "version": "", "sha256": plugins._module(SENSORS).__name__[12:]}
    stream = Clip.open(clip.path).stream("s")
    assert type(stream.sensor).__name__ == kind
    assert main(["check", str(clip.path), "--redraw"]) == 0
    monkeypatch.setenv(plugins.VARIABLE, "")
    with pytest.raises(
        ValueError, match=rf"the sensor {kind} of sensors.py is not on this machine; put its file into QSIM_PLUGINS"
    ):
        _ = Stream.open(clip.path / "streams" / "s.json").sensor
    monkeypatch.setenv(plugins.VARIABLE, f"/nowhere/other.py:{SENSORS}")
    assert Stream.open(clip.path / "streams" / "s.json").sensor == stream.sensor


def test_a_stream_of_a_package_names_module_and_version(tmp_path: Path, package: None):
    clip = clip_in(tmp_path)
    stream = clip.sense("trigger", ppp=4.0, name="s")
    about = json.loads((clip.path / "streams" / "s.json").read_text())["sensor"]["plugin"]
    assert (about["module"], about["version"], len(about["sha256"])) == ("own_parts.sensors", "1.0", 64)
    assert Stream.open(stream.path.with_suffix(".json")).sensor.threshold == 5
    assert "trigger" in devices.names()


def test_a_record_of_an_installed_class_is_sensed(tmp_path: Path, package: None):
    from own_parts.sensors import Trigger

    clip = clip_in(tmp_path)
    assert clip.sense(Trigger(threshold=3), ppp=4.0, name="s").sensor == Trigger(threshold=3)


def test_a_stream_of_a_package_is_refused_without_it(tmp_path: Path, package: None, monkeypatch):
    clip = clip_in(tmp_path)
    clip.sense("trigger", ppp=4.0, name="s")
    monkeypatch.setattr(plugins.metadata, "entry_points", lambda group: ())
    plugins._entries.cache_clear()
    with pytest.raises(ValueError, match=r"Trigger of own_parts\.sensors 1\.0 is not on this machine; install the p"):
        _ = Clip.open(clip.path).stream("s").sensor


def test_an_edited_module_is_told(tmp_path: Path):
    mine = tmp_path / "mine.py"
    mine.write_text(SENSORS.read_text())
    clip = clip_in(tmp_path)
    clip.sense(f"{mine}:Noisy", ppp=4.0, name="s")
    mine.write_text(SENSORS.read_text() + "\n# edited\n")
    with pytest.warns(UserWarning, match=r"was written with another mine\.py; codes that are drawn again may differ"):
        _ = Stream.open(clip.path / "streams" / "s.json").sensor


@pytest.mark.parametrize("kind", ["Trigger", "Noisy"])
def test_codes_do_not_depend_on_blocks_and_survive_pickling(kind: str):
    sensor = devices.load(f"{SENSORS}:{kind}")
    light = np.random.default_rng(0).uniform(0, 12, (3, 9, 17))
    whole = sensor.sample(light, 1e-3, key=Key(0, 1), engine="reference")
    part = sensor.sample(light[1:, 2:7, 4:], 1e-3, key=Key(0, 1).at(1), origin=(2, 4), engine="reference")
    assert np.array_equal(whole[1:, 2:7, 4:], part)
    again = pickle.loads(pickle.dumps(sensor))
    assert again.sample(light, 1e-3, key=Key(0, 1)).tolist() == whole.tolist()
    where = np.array([[0, 2], [1, 3], [5, 6]])
    assert sensor.draw_at(light[tuple(where)], 1e-3, key=Key(0, 1), at=where).tolist() == whole[tuple(where)].tolist()


def test_what_needs_a_law_refuses_a_sensor_without_one():
    sensor = devices.load(f"{SENSORS}:Noisy")
    for action in (sensor.response, lambda exposure: sensor.mean(np.ones(3), exposure)):
        with pytest.raises(ValueError, match="Noisy: states how codes are drawn and not their law"):
            action(1e-3)


def test_a_recipe_finds_a_sensor_beside_it_and_its_content_counts(tmp_path: Path):
    mine = tmp_path / "mine.py"
    mine.write_text(SENSORS.read_text())
    text = '[recipe]\nname = "r"\nframes = 2\nheight = 8\nwidth = 8\n[[scenes]]\nfamily = "fan"\n'
    text += '[[streams]]\nsensor = "mine.py:Trigger"\nppp = 3.0\n'
    job = recipe.parse(text, tmp_path / "r.toml").jobs[0]
    assert job.streams[0] == Sensing(f"{mine}:Trigger", ppp=3.0)
    assert job.streams[0].stream_name == "mine-Trigger_3ppp"
    before = job.digest
    mine.write_text(SENSORS.read_text() + "\n# edited\n")
    assert recipe.parse(text, tmp_path / "r.toml").jobs[0].digest != before


BROKEN = {
    "absent.py:X": (None, "absent.py: no such file"),
    "a.py:Y": ("X = 1", r"a\.py: has no Y$"),
    "a.py:X": ("X = 1", "is no sensor; name a class below qsim.Sensor"),
    "b.py:X": ("1 / 0", r"b\.py: cannot be run \(ZeroDivisionError: division by zero\)"),
    "c.py:X": ("def X(size, bits): return size", "needs size, bits; give defaults, or name a function that makes"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path: Path, name: str):
    content, message = BROKEN[name]
    if content is not None:
        (tmp_path / name.partition(":")[0]).write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        devices.load(f"{tmp_path}/{name}")
    assert "\n" not in str(caught.value)


def test_a_method_of_a_file_stands_where_others_do(tmp_path: Path, monkeypatch):
    clip = clip_in(tmp_path)
    stream = clip.sense("quiver-physical", bits=3, ppp=4.0)
    method = restorer(f"{METHODS}:restore:3")
    assert (method.name, method.description) == ("methods-restore:3", "The mean of all codes that are given.")
    assert method.identity["module"] == "methods.py"
    import quiver

    video = quiver.restore(stream, method=f"{METHODS}:restore")
    assert video.shape == stream.shape
    assert np.allclose(video[0], stream.codes().mean(axis=0) / 7 * stream.sensor.white(stream.exposure), rtol=1e-5)


def test_a_method_of_a_package_is_among_the_names(package: None):
    assert restorer("own-mean").description == "The mean of all codes that are given."
    from quiver.restoration.restorers import method_names

    assert "own-mean" in method_names()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("def f(codes): return codes", "window and frames is missing"),
        ("f = 3", "is no function"),
    ],
)
def test_a_wrong_method_is_refused(tmp_path: Path, code: str, message: str):
    (tmp_path / "m.py").write_text(code)
    with pytest.raises(ValueError, match=message):
        restorer(f"{tmp_path}/m.py:f")


def test_a_method_of_another_shape_is_named(tmp_path: Path):
    (tmp_path / "m.py").write_text("def f(codes, sensor, exposure, *, window=3, frames=None): return codes[:, :1]")
    stream = clip_in(tmp_path).sense("quiver-physical", bits=3, ppp=4.0)
    import quiver

    with pytest.raises(ValueError, match=r"m\.py:f: returned \[4, 1, 16\], expected \[4, 12, 16\]"):
        quiver.restore(stream, method=f"{tmp_path}/m.py:f")


def test_a_stored_name_runs_no_file(tmp_path: Path):
    """A description from elsewhere names a file beside it: it is not run."""
    clip = clip_in(tmp_path)
    clip.sense(f"{SENSORS}:Noisy", ppp=4.0, name="s")
    (clip.path / "sensors.py").write_text("raise SystemExit('was run')")
    code = f"import qsim; qsim.Clip.open({str(clip.path)!r}).stream('s').sensor"
    env = {name: value for name, value in os.environ.items() if name != plugins.VARIABLE}
    run = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, cwd=clip.path)
    assert "is not on this machine; put its file into QSIM_PLUGINS" in run.stderr
