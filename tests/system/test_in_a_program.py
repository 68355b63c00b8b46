"""The packages inside of other programs: results are those of a quiet main thread, whatever the host has set.

Quick: each public function that is quick, in a host that has set everything, and in its event loop. Slow: all of them,
in threads too, and in processes that were forked or spawned.
"""

from __future__ import annotations

import copy
import gc
import inspect
import os
import pickle
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import program_cases
import pytest
import tiny_clip
from compiled_cases import needs_engine
from program_cases import CAMERA, KEY, SENSORS, calls, plain, slow_calls
from small_scenes import CHEAP, plate

import qsim
import quiver
from qsim import host
from qsim.dataset.dataset import DatasetInfo
from qsim.scene import Spin
from quiver.model.presets import build

SUPPORT = Path(program_cases.__file__).parent


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("shared")
    program_cases.prepare(place)
    return place


@pytest.fixture(scope="module")
def quiet(shared, tmp_path_factory) -> program_cases.Made:
    found = program_cases.answers(calls(shared), tmp_path_factory.mktemp("quiet") / "q")
    assert [name for name, answer in found.items() if b"Error" in answer] == []  # it would agree with itself
    return found


def assert_same(found: program_cases.Made, quiet: program_cases.Made) -> None:
    """Fail with the names of the calls whose answers differ, and with the errors that they raised."""
    assert {name: answer[:300] for name, answer in found.items() if answer != quiet[name]} == {}
    assert found.keys() == quiet.keys()


@pytest.mark.parametrize("way", [program_cases.in_place, program_cases.in_an_event_loop])
def test_what_the_host_has_set_changes_no_result(way, shared, quiet, tmp_path):
    with program_cases.everything():
        (found,) = way(calls(shared), tmp_path / "hosted")
        assert np.geterr()["under"] == "raise"  # given back
    assert_same(found, quiet)


def test_without_its_own_numbers_the_tails_would_raise(shared, quiet, tmp_path, monkeypatch):
    """The calls reach what they are there for."""
    monkeypatch.setattr(host, "numbers", nullcontext)
    some = {name: call for name, call in calls(shared).items() if name.endswith((".pmf", ".sample"))}
    with program_cases.numpy_raises():
        found = program_cases.answers(some, tmp_path / "bare")
    assert sum(b"FloatingPointError" in answer for answer in found.values()) >= len(SENSORS)


@pytest.mark.slow
@needs_engine
@pytest.mark.parametrize("way", [program_cases.in_place, program_cases.in_threads, program_cases.in_an_event_loop])
@pytest.mark.parametrize("of_host", ["numpy_raises", "warnings_are_errors", "torch_of_doubles"])
@pytest.mark.filterwarnings("ignore:.*never measured")
def test_slow_calls_in_every_host(of_host, way, shared, tmp_path):
    found = calls(shared) | slow_calls(shared)
    expected = program_cases.answers(found, tmp_path / "quiet")
    with getattr(program_cases, of_host)():
        for made in way(found, tmp_path / "hosted"):
            assert_same(made, expected)


PROGRAM = """
import multiprocessing, sys
from pathlib import Path
import program_cases as cases

def child(place):
    return cases.answers(cases.calls(Path(sys.argv[1])), Path(place))

if __name__ == "__main__":
    before = child(sys.argv[2] + "/parent")
    with multiprocessing.get_context(sys.argv[3]).Pool(2) as pool:
        for found in pool.map(child, [sys.argv[2] + "/child0", sys.argv[2] + "/child1"]):
            assert found == before, [name for name in found if found[name] != before[name]]
    print("equal")
"""


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_child_processes_give_the_results_of_their_parent(start, shared, tmp_path):
    """Also those of a parent that has used both engines, and torch."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    words = [sys.executable, str(program), str(shared), str(tmp_path), start]
    run = subprocess.run(words, capture_output=True, text=True, check=False, env=_with_support(), timeout=300)
    assert (run.returncode, run.stdout) == (0, "equal\n"), run.stderr[-2000:]


def _with_support() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")])}


# Copies


@pytest.fixture(scope="module")
def examples(shared) -> dict[str, Any]:
    """Return an object of each public class, by its name."""
    clip = qsim.Clip.open(shared / "clip")
    stream = clip.stream("s")
    return {
        **{type(sensor).__name__: sensor for sensor in SENSORS.values()},
        "Budget": qsim.Budget(samples=9),
        "Camera": CAMERA,
        "Clip": clip,
        "ClipInfo": clip.info,
        "ClipWriter": qsim.ClipWriter(shared / "other", tiny_clip.meta()),
        "Dataset": qsim.Dataset(shared, DatasetInfo(name="d")),
        "Key": KEY,
        "PlaneSums": qsim.PlaneSums(planes=7),
        "Scene": plate(Spin((0, 0, 1), 200.0)),
        "Sensing": qsim.Sensing("quiver-physical", ppp=3.25),
        "Stream": stream,
        "EventCamera": qsim.EventCamera(),
        "EventStream": clip.sense_events("dvs", ppp=100, name="events", force=True),
        "Response": SENSORS["QIS"].response(5e-4),
        "codes": stream.codes,
        "windows": quiver.windows(stream, frames=3, crop=4),
        "score": quiver.score(np.zeros(stream.shape, np.float32), stream),
    }


COPIES = {
    "copy": copy.copy,
    "deep copy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
}
ELSEWHERE = {"Sensor", "DrawnSensor", "Renderer", "QUIVER"}  # two for subclasses; in the next test; as all networks


def test_every_public_class_has_an_example(examples):
    names = {(name, getattr(package, name)) for package in (qsim, quiver) for name in package.__all__}
    assert {name for name, value in names if inspect.isclass(value)} - ELSEWHERE <= examples.keys()
    for _, value in names:
        assert pickle.loads(pickle.dumps(value)) is value


@pytest.mark.parametrize("way", COPIES)
def test_copies_hold_what_their_original_holds(way, examples):
    for name, value in examples.items():
        made = COPIES[way](value)
        assert type(made) is type(value), name
        if name in ("ClipWriter", "windows"):
            continue
        if name == "codes":
            np.testing.assert_array_equal(np.asarray(made), np.asarray(value))
        assert plain(made) == plain(value), name
    made = COPIES[way](examples["windows"])
    assert plain(made[1]) == plain(examples["windows"][1])
    with COPIES[way](examples["ClipWriter"]) as writer:
        assert not writer.has(0)
        for t in range(tiny_clip.FRAMES):
            writer.add(t, tiny_clip.radiance(t))
    assert len(qsim.Clip.open(writer.path)) == tiny_clip.FRAMES
    writer.force = examples["ClipWriter"].force = True  # for the next way


@pytest.mark.parametrize("way", COPIES)
def test_a_copied_network_restores_alike(way):
    network = build("mergenet")
    made = COPIES[way](network)
    assert [plain(value) for value in made.state_dict().values()] == [
        plain(value) for value in network.state_dict().values()
    ]


@needs_engine
@pytest.mark.parametrize("way", COPIES)
def test_a_copied_renderer_renders_alike(way):
    budget = replace(CHEAP, neighbours=1)
    renderer = qsim.Renderer(plate(Spin((0, 0, 1), 200.0)), seed=3, budget=budget, crop=(2, 3, 8, 9), frames=3)
    made = COPIES[way](renderer)
    np.testing.assert_array_equal(made.frame(1).radiance, renderer.frame(1).radiance)


@needs_engine
def test_a_copied_clip_keeps_its_temporary_folder():
    """Also when the original is gone; a pickle does not keep it."""
    clip = qsim.render(plate(None), frames=1, budget=CHEAP)
    light = clip.radiance(0)
    made = copy.deepcopy(clip)
    folder = clip.path
    del clip
    gc.collect()
    np.testing.assert_array_equal(made.radiance(0), light)
    del made
    gc.collect()
    assert not folder.exists()
