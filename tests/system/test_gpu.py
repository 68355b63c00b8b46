"""benchmarks/gpu.py: pieces, resuming, failures and mistakes with faked measurements; the true ones, tiny, are slow."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
PARTS = ROOT / "benchmarks" / "gpu"

# Runs the true child.py with faked sections. What each measurement does stands in acts.json: {"SECTION.NAME": act}.
FAKE = """
import json, os, sys, time, types
from pathlib import Path
sys.path.insert(0, {parts!r})
here = Path({here!r})
import child, job

def names(section):
    acts = json.loads((here / "acts.json").read_text())
    found = [name.partition(".")[2] for name in acts if name.startswith(section)]
    if found == ["missing"]:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    return found

def measure(work):
    act = json.loads((here / "acts.json").read_text())[work.section + "." + work.name]
    with open(here / "made.txt", "a") as made:
        made.write(f"{{work.section}}.{{work.name}} {{os.getpid()}}\\n")
    if act == "fail":
        raise ValueError("the scene is black")
    if act == "absent":
        raise job.Absent("no CUDA device here")
    if act == "crash":
        os.abort()
    if act == "leave":
        os._exit(0)
    if act == "import":
        import tinywheel
        return [{{"found": tinywheel.VALUE}}]
    if act == "part":  # one part, and then another that does not end
        work.is_over()
        time.sleep(60)
    work.stopped = act == "long"
    time.sleep(act if isinstance(act, (int, float)) else 0)
    return [{{"name": work.name, "pid": os.getpid()}}]

for section in job.SECTIONS:
    module = types.ModuleType(section)
    module.names, module.measure = (lambda sizes, section=section: names(section)), measure
    sys.modules[section] = module
child.main()
"""


class Bench:
    """A folder of results, faked measurements, and what they did."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.out = folder / "out"
        (folder / "fake.py").write_text(FAKE.format(parts=str(PARTS), here=str(folder)))
        self.child = (sys.executable, str(folder / "fake.py"))
        self.acts()

    def acts(self, **changes: object) -> None:
        """One measurement of each section, and changes to what they do; None removes one."""
        usual = {"doctor.machine": 0, "sensor.one": 0, "render.one": 0, "train.one": 0, "restore.one": 0}
        acts = usual | {name.replace("_", "."): act for name, act in changes.items()}
        (self.folder / "acts.json").write_text(json.dumps({k: v for k, v in acts.items() if v is not None}))

    def __call__(self, *words: str) -> int:
        import pieces

        return pieces.main([str(self.out), *words], child=self.child)

    def made(self) -> list[str]:
        """The measurements that began since the last call."""
        file = self.folder / "made.txt"
        found = [line.split()[0] for line in file.read_text().splitlines()] if file.exists() else []
        file.unlink(missing_ok=True)
        return found

    def state(self, name: str) -> str | None:
        found = json.loads((self.out / f"{name.replace('.', '/', 1)}.json").read_text())
        return found["state"]


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(PARTS))
    return Bench(tmp_path)


def told(capsys) -> str:
    return capsys.readouterr().err


def test_importing_the_program_runs_nothing():
    code = (
        "import runpy; found = runpy.run_path('benchmarks/gpu.py', run_name='gpu');print(sorted(set(found) & {'main'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--minutes", "0"], "expected a number of minutes above 0, got '0'"),
        (["--minutes", "-3"], "expected a number of minutes above 0, got '-3'"),
        (["--minutes", "nan"], "got 'nan'"),
        (["--minutes", "inf"], "got 'inf'"),
        (["--minutes", "ten"], "got 'ten'"),
        (["--section", "rendering"], "invalid choice: 'rendering'"),
        (["another"], "unrecognized arguments: another"),
        (["--force"], "unrecognized arguments: --force"),
        (["--quarter", "--section", "sensor"], "--quarter has its own list of measurements; leave --section out"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(bench, capsys, words, message):
    with pytest.raises(SystemExit) as ended:
        bench(*words)
    assert ended.value.code == 2
    assert message in told(capsys)
    assert not bench.out.exists()


def of_a_quarter(act: object = 0) -> dict[str, object]:
    """The same act for all measurements of a quarter of an hour."""
    from job import QUARTER

    return {f"{section}.{name}": act for section, name, _ in QUARTER}


def test_a_quarter_of_an_hour_goes_in_order_of_worth(bench, capsys):
    bench.acts(**of_a_quarter())
    assert bench("--quarter") == 0
    assert bench.made() == list(of_a_quarter())
    assert json.loads((bench.out / "doctor/machine.json").read_text())["minutes"] == 13
    assert "14 of 14 measured, 0 failed, 0 not possible here, 0 to do" in capsys.readouterr().out
    assert bench("--quarter") == 0
    assert bench.made() == []


def test_what_takes_too_long_in_a_quarter_takes_nothing_from_the_rest(bench, monkeypatch, capsys):
    """It is measured again by the same command; a run that is not finished does not end the quarter."""
    import pieces

    bench.acts(**of_a_quarter() | {"sensor.torch-cuda": 60, "equal.merge": "fail", "learn.quiver-s": "long"})
    short = [(section, name, 1.0 if section == "sensor" else most) for section, name, most in pieces.QUARTER]
    monkeypatch.setattr(pieces, "QUARTER", short)
    assert bench("--quarter") == 1
    assert bench.made() == list(of_a_quarter())
    said = capsys.readouterr().out
    assert "sensor: torch-cuda ... open" in said
    assert "11 of 14 measured, 1 failed, 0 not possible here, 2 to do by the same command" in said
    bench.acts(**of_a_quarter())
    assert bench("--quarter") == 1
    assert bench.made() == ["sensor.torch-cuda", "learn.quiver-s"]


def test_a_quarter_measures_what_the_sections_name(bench):
    """At the sizes that are the default."""
    import importlib

    from job import QUARTER
    from sizes import Sizes

    named = {section: importlib.import_module(section).names(Sizes()) for section, _, _ in QUARTER}
    by_gpu = {"batches-21-bfloat16"}  # a precision that a CPU is not asked for
    assert all(name in named[section] or name in by_gpu for section, name, _ in QUARTER)


def test_weights_travel_in_small_parts(bench, tmp_path, monkeypatch):
    import learn

    from quiver.model import weights
    from quiver.model.presets import build

    run = tmp_path / "run"
    run.mkdir()
    network = build("unet-1m")
    weights.save(network, network.config, run / "best.safetensors", {"step": "3"})
    for name in ("history.json", "schedule.json"):
        (run / name).write_text("{}")
    most = (run / "best.safetensors").stat().st_size // 7
    monkeypatch.setattr(learn, "PART", most)
    learn.keep(run, tmp_path / "keep")
    learn.keep(run, tmp_path / "keep")
    parts = sorted((tmp_path / "keep").glob("quiver-s.safetensors.*"))
    assert len(parts) == 4
    assert all(part.stat().st_size <= most for part in parts)
    joined = tmp_path / "joined.safetensors"
    joined.write_bytes(b"".join(part.read_bytes() for part in parts))
    assert joined.stat().st_size < 0.6 * (run / "best.safetensors").stat().st_size
    found = weights.load(joined).state_dict()
    for name, value in network.state_dict().items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value.half().float() if value.dtype == torch.float32 else value)
    assert weights.metadata_of(joined)["step"] == "3"


def test_what_is_measured_is_not_measured_again(bench, capsys):
    assert bench() == 0
    assert bench.made() == ["doctor.machine", "sensor.one", "render.one", "train.one", "restore.one"]
    assert "5 of 5 measured, 0 failed, 0 not possible here, 0 to do" in capsys.readouterr().out
    assert bench() == bench("--section", "sensor") == bench("--section", "table") == 0
    assert bench.made() == []
    table = json.loads((bench.out / "table.json").read_text())
    assert table["records"]["train"]["one"]["rows"][0]["name"] == "one"
    assert table["records"]["train"]["one"]["command"] == "python benchmarks/gpu.py OUT --minutes 9"
    assert "## restore" in (bench.out / "table.md").read_text()


@pytest.mark.parametrize(
    ("act", "state", "why"),
    [
        ("fail", "failed", "ValueError: the scene is black"),
        ("crash", "failed", "its process ended with signal SIGABRT"),
        pytest.param("leave", "failed", "its process ended with exit code 0", marks=pytest.mark.slow),
        pytest.param("absent", "absent", "no CUDA device here", marks=pytest.mark.slow),
    ],
)
def test_a_failing_section_states_why_and_the_others_are_measured(bench, capsys, act, state, why):
    bench.acts(render_one=act)
    assert bench() == (1 if state == "failed" else 0)
    assert [bench.state(f"{section}.one") for section in ("sensor", "train", "restore")] == ["done"] * 3
    assert bench.state("render.one") == state
    assert f"render: one ... {state}, 0 s: {why}" in capsys.readouterr().out.replace("1 s", "0 s").replace("2 s", "0 s")
    assert f"- one: {state}: {why}" in (bench.out / "table.md").read_text()
    bench.made()
    bench()
    assert bench.made() == []  # the same program and packages would fail again
    bench.acts()
    assert bench("--section", "render") == 0
    assert bench.made() == ["render.one"]
    assert bench.state("render.one") == "done"


def test_a_missing_package_is_named_and_its_section_is_measured_when_it_is_there(bench, monkeypatch):
    import folder

    bench.acts(train_one=None, train_missing=0)
    assert bench() == 0
    record = json.loads((bench.out / "train" / "all.json").read_text())
    assert record["state"] == "absent"
    assert record["why"] == (
        "needs the package torch, which is not installed; install it, or name wheels with --wheels FOLDER"
    )
    assert bench.made() == ["doctor.machine", "sensor.one", "render.one", "restore.one"]
    bench.acts()
    version = folder.version
    monkeypatch.setattr(folder, "version", lambda name, where: "9.9" if name == "torch" else version(name, where))
    assert bench() == 0
    assert bench.made() == ["doctor.machine", "train.one"]  # the doctor looks again when packages change
    assert not (bench.out / "train" / "all.json").exists()


def test_a_piece_ends_in_time_and_the_next_one_continues(bench, capsys):
    bench.acts(sensor_one=60, doctor_machine=None)
    assert bench("--minutes", "0.02") == 1  # about a second: the first measurement is given up
    assert bench.state("sensor.one") == "late"
    assert "took longer than the 0.02 minutes of its piece; give more --minutes" in capsys.readouterr().out
    bench.acts(doctor_machine=None)
    assert bench("--minutes", "0.02") == 1  # not tried again in so short a piece
    assert bench.state("sensor.one") == "late"
    assert bench("--minutes", "0.5") == 0
    assert bench.state("sensor.one") == "done"


def test_a_measurement_that_is_not_the_first_is_done_by_the_next_piece(bench):
    import pieces

    bench.acts(sensor_one=60)
    bench.out.mkdir()
    piece = pieces.Piece(bench.out, None, 9.0, {}, bench.child)
    assert pieces.measure(piece, "sensor", "one", {}, 0.5, first=False) == "open"
    assert not (bench.out / "sensor" / "one.json").exists()
    assert pieces.measure(piece, "sensor", "one", {}, 0.5, first=True) == "late"


def test_a_measurement_stops_before_its_end(bench, tmp_path):
    import job
    from sizes import Sizes

    for seconds, left, stops in ((540.0, 21.0, False), (540.0, 19.0, True), (10.0, 3.0, False), (10.0, 1.0, True)):
        end = time.monotonic() + left
        work = job.Job("train", "data", tmp_path, tmp_path / "data.json", Sizes(), seconds, end, {})
        assert work.is_over() == work.stopped == stops
    now = time.monotonic()
    for longest, left, stops in ((100.0, 130.0, False), (100.0, 120.0, True)):  # room for another part, or not
        work = job.Job("train", "data", tmp_path, tmp_path / "data.json", Sizes(), 540.0, now + left, {})
        work.last = now - longest
        assert work.is_over() == stops


def test_a_resumable_measurement_keeps_what_it_has(bench):
    bench.acts(train_one="long", doctor_machine=None, sensor_one=None, render_one=None, restore_one=None)
    assert bench() == 0
    assert bench.state("train.one") == "unfinished"
    assert "- one: unfinished: the next piece continues it" in (bench.out / "table.md").read_text()
    assert "| one |" in (bench.out / "table.md").read_text()
    bench.acts()
    assert bench("--section", "train") == 0
    assert bench.state("train.one") == "done"


@pytest.mark.slow
def test_what_is_killed_after_a_part_continues_in_the_next_piece(bench, capsys):
    """A clip that takes longer than those before it makes no measurement "late", which the same command leaves."""
    bench.acts(train_one="part", doctor_machine=None, sensor_one=None, render_one=None)
    assert bench("--minutes", "0.05") == 0
    assert "train: one ... unfinished" in capsys.readouterr().out
    assert bench.made() == ["train.one"]  # what follows may need it
    record = json.loads((bench.out / "train" / "one.json").read_text())
    (bench.out / "train" / "one.json").write_text(json.dumps(record | {"rows": [{"clips": 3}]}))
    assert bench("--minutes", "0.05") == 0
    assert json.loads((bench.out / "train" / "one.json").read_text())["rows"] == [{"clips": 3}]
    assert bench.state("train.one") == "unfinished"
    bench.acts(doctor_machine=None, sensor_one=None, render_one=None)
    assert bench("--minutes", "0.5") == 0
    assert bench.state("train.one") == bench.state("restore.one") == "done"


@pytest.mark.parametrize(
    ("state", "why"),
    [("late", "too long"), ("failed", "black"), ("absent", "no mitsuba"), (None, "it is not complete")],
)
def test_nothing_is_trained_on_a_part_of_the_data_set(bench, state, why):
    import train
    from job import Absent, Job
    from sizes import Sizes

    folder = bench.out / "train"
    folder.mkdir(parents=True)
    (bench.out / "data").mkdir()
    (bench.out / "data" / "dataset.json").write_text("{}")  # it is there from the first clip on
    record = {"state": state, "why": why, "setup": {}, "minutes": 9, "command": ""}
    if state is not None:
        (folder / "data.json").write_text(json.dumps(record))
    work = Job("train", "mergenet-float32", bench.out, folder / "mergenet-float32.json", Sizes(), 540.0, 1e9, {})
    with pytest.raises(Absent, match=f"needs the data set, see train/data: {why}") as told:
        train.measure(work)
    assert told.value.state == (state or "absent")
    (folder / "data.json").write_text(json.dumps(record | {"state": "done"}))
    train.check_data(work)


def test_a_measurement_whose_parent_ended_at_once_ends_too():
    command = [sys.executable, str(PARTS / "child.py")]
    for told in (b"", b'{"section": '):
        assert subprocess.run(command, input=told, timeout=60, check=False).returncode == 0


def test_a_measurement_finds_its_files_where_python_leaves_out_their_folder(bench, monkeypatch):
    import pieces

    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    bench.out.mkdir()
    piece = pieces.Piece(bench.out, None, 9.0, {}, pieces.CHILD)
    job = {"section": "table", "name": "table", "out": str(bench.out), "record": {}}
    assert pieces.run_child(piece, job, bench.out / "table.json", 60.0) is None


def test_numbers_that_json_does_not_know_are_left_out(bench, tmp_path):
    import child
    import folder

    values = [float("nan"), float("inf"), -float("inf"), 1.5, 3, "nan", None]
    assert [child.finite(value) for value in values] == [None, None, None, 1.5, 3, "nan", None]
    with pytest.raises(ValueError, match="JSON"):
        folder.write(tmp_path / "a.json", {"rows": [{"x": float("inf")}]})
    assert not (tmp_path / "a.json").exists()


def _start(bench: Bench, *words: str) -> subprocess.Popen[bytes]:
    call = f"main({[str(bench.out), *words]!r}, child={bench.child!r})"
    wakes = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # in the background it is ignored
    code = f"{wakes}; import sys; sys.path.insert(0, {str(PARTS)!r}); from pieces import main; sys.exit({call})"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def _gone(pid: int) -> bool:
    """Whether a process has ended, also if nobody has asked for its exit code yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.slow
def test_killed_at_any_moment_it_continues_and_leaves_no_process(bench):
    rng = random.Random(0)
    bench.acts(**{f"sensor_n{i}": 0.05 for i in range(4)})
    pids = []
    for _ in range(3):
        process = _start(bench)
        time.sleep(rng.uniform(0.1, 1.0))
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    made = bench.folder / "made.txt"
    pids = [int(line.split()[1]) for line in made.read_text().splitlines()] if made.exists() else []
    end = time.monotonic() + 20
    while not all(map(_gone, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert all(map(_gone, pids))
    assert bench() == 0
    records = [file for section in bench.out.iterdir() if section.is_dir() for file in section.glob("*.json")]
    assert len(records) == 9
    assert {json.loads(file.read_text())["state"] for file in records} == {"done"}
    bench.made()
    assert bench() == 0
    assert bench.made() == []


def test_ctrl_c_ends_the_measurement_and_prints_one_line(bench):
    bench.acts(doctor_machine=60)
    process = _start(bench)
    made = bench.folder / "made.txt"
    end = time.monotonic() + 30
    while not made.exists() and time.monotonic() < end:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 130
    assert out.decode().endswith("gpu.py: interrupted; the same command continues there\n")
    assert _gone(int(made.read_text().split()[1]))


def test_damaged_records_are_measured_again(bench):
    damages = {
        "sensor": b"",
        "render": b"[1, 2]",
        "train": b"\xff\xfe\x00",
        "restore": b"[" * 5000,
        "doctor": b'{"state": "late", "setup": []}',
    }
    assert bench() == 0
    assert len(bench.made()) == 5
    for section, damage in damages.items():
        next((bench.out / section).glob("*.json")).write_bytes(damage)
    for name in ("table.json", "plan.json"):
        (bench.out / name).write_bytes(b'{"state": "done"')
    assert bench() == 0
    assert sorted(bench.made()) == sorted(f"{s}.{'machine' if s == 'doctor' else 'one'}" for s in damages)
    assert json.loads((bench.out / "table.json").read_text())["records"]["sensor"]["one"]["state"] == "done"


def test_folders_that_are_not_ours_are_refused(bench, capsys):
    bench.out.mkdir()
    (bench.out / "thesis.tex").write_text("x")
    assert bench() == 2
    assert told(capsys) == f"gpu.py: {bench.out}: holds files that this program did not write; name an empty folder\n"
    assert [path.name for path in bench.out.iterdir()] == ["thesis.tex"]
    shutil.rmtree(bench.out)
    bench.out.write_text("x")
    assert bench() == 2
    assert told(capsys) == f"gpu.py: {bench.out}: is a file; name a folder\n"
    bench.out = bench.out / "below"
    assert bench() == 2
    assert "cannot be written" in told(capsys)


def test_results_of_another_machine_or_size_are_not_mixed(bench, monkeypatch, capsys):
    import folder
    import pieces

    assert bench() == 0
    (bench.folder / "made.txt").unlink()
    assert pieces.main([str(bench.out)], child=bench.child, sizes={"steps": 2}) == 2
    assert "holds results of another machine (measurements of other sizes); name another folder" in told(capsys)
    here = folder.machine()
    monkeypatch.setattr(folder, "machine", lambda: here | {"gpus": ["NVIDIA H200, 1.0, 9 MiB"]})
    assert bench() == 2
    assert "holds results of another machine (gpus" in told(capsys)
    monkeypatch.undo()
    for damage in (b"{", b"{}", b'{"machine": 3, "sizes": {}}'):
        (bench.out / "machine.json").write_bytes(damage)
        assert bench() == 2
        assert told(capsys) == f"gpu.py: {bench.out / 'machine.json'}: is damaged; name another folder\n"
    assert bench.made() == []


def test_one_process_at_a_time(bench, capsys):
    import fcntl

    bench.out.mkdir()
    with open(bench.out / "lock", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert bench() == 2
    assert "another process measures there" in told(capsys)
    assert bench() == 0


def _wheel(folder: Path, name: str, version: str, text: str) -> None:
    """Write a wheel of one module."""
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as file:
        about = f"{name}-{version}.dist-info"
        file.writestr(f"{name}.py", text)
        file.writestr(
            f"{about}/METADATA",
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nRequires-Dist: a-package-of-no-index\n",
        )
        file.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{about}/RECORD", "")


@pytest.mark.slow
def test_wheels_serve_measurements_and_replace_nothing(bench, tmp_path, capsys):
    pytest.importorskip("pip")
    wheels = tmp_path / "wheels of mine"
    wheels.mkdir()
    _wheel(wheels, "tinywheel", "1.0", "VALUE = 17\n")
    _wheel(wheels, "numpy", "99.0", "raise SystemExit('a second NumPy')\n")
    (wheels / "broken-1.0-py3-none-any.whl").write_bytes(b"no archive")
    (wheels / "--index-url=x-1.0-py3-none-any.whl").write_bytes(b"an option")
    (wheels / "sourced-1.0.tar.gz").write_bytes(b"would run a program")
    bench.acts(sensor_one="import")
    assert bench() == 0
    assert bench.state("sensor.one") == "absent"  # no tinywheel
    assert bench("--wheels", str(wheels), "--section", "sensor") == 0
    out = capsys.readouterr().out
    assert "wheels of 3 packages; this machine lacks broken, tinywheel" in out
    assert "broken: not installed: " in out
    record = json.loads((bench.out / "sensor" / "one.json").read_text())
    assert record["rows"] == [{"found": 17}]
    assert sorted(path.name for path in (bench.out / "packages").glob("*.py")) == ["tinywheel.py"]
    assert not list(bench.out.glob("packages.tmp-*"))


def test_a_folder_without_wheels_is_refused(bench, tmp_path, capsys):
    assert bench("--wheels", str(tmp_path / "none")) == 2
    assert told(capsys) == f"gpu.py: --wheels {tmp_path / 'none'}: no such folder\n"
    assert bench("--wheels", str(tmp_path)) == 2
    assert told(capsys) == f"gpu.py: --wheels {tmp_path}: holds no .whl file\n"


def test_the_table_leaves_out_what_it_cannot_read(bench):
    import table

    kept = {"state": "done", "setup": {"program": "1f"}, "command": "python benchmarks/gpu.py OUT", "minutes": 9}
    page = "\n".join(
        table.page(
            {"gpus": ["NVIDIA H200"], "cores": 2},
            {
                "sensor": {"a": kept | {"rows": [{"by": "cu|da", "Gpixel/s": 1.23456, "more": None}]}},
                "train": {
                    "b": kept | {"state": "late", "why": "too long", "rows": "damaged"},
                    "c": kept | {"rows": [3]},
                },
                "render": {},
            },
        )
    )
    assert page.startswith("# NVIDIA H200\n")
    assert "| by | Gpixel/s | more |\n| --- | --- | --- |\n| cu\\|da | 1.235 |  |" in page
    assert "- b: late: too long" in page
    assert "render" not in page


# The true measurements

HIDE = """
import importlib.abc, sys

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
"""


@pytest.mark.parametrize(
    ("hidden", "section", "name"),
    [("torch", "train", "all"), pytest.param("numpy", "sensor", "engine-llvm", marks=pytest.mark.slow)],
)
def test_without_a_package_the_true_measurements_name_it(tmp_path, hidden, section, name):
    (tmp_path / "sitecustomize.py").write_text(HIDE.format(hidden={hidden}))
    command = [sys.executable, "benchmarks/gpu.py", str(tmp_path / "out"), "--section", section, "--minutes", "1"]
    path = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=path, check=False)
    record = json.loads((tmp_path / "out" / section / f"{name}.json").read_text())
    assert record["state"] == "absent", done.stdout + done.stderr
    assert record["why"].startswith(f"needs the package {hidden}, which is not installed")


TINY = {
    "height": 16,
    "width": 32,
    "sensor_pixels": 1 << 16,
    "rounds": 1,
    "families": ["fan"],
    "frames": 1,
    "psnr": 20.0,
    "check_height": 16,
    "check_width": 24,
    "reference_samples": 256,
    "train_families": ["fan"],
    "train_psnr": 20.0,
    "train_seeds": 1,
    "train_frames": 12,
    "train_height": 32,
    "train_width": 32,
    "crop": 32,
    "batch": 1,
    "steps": 2,
    "step_batches": [1, 2],
    "step_frames": [11, 12],
    "compiled": ["off"],
    "compiled_batch": 1,
    "step_crop": 16,
    "step_height": 24,
    "step_width": 28,
    "step_count": 1,
    "window_batch": 2,
    "peak_side": 64,
    "copied_batches": 2,
    "restored": 2,
    "restored_slow": 2,
    "compared_side": 16,
    "learn_on_gpu": False,
    "learn_frames": 12,
    "learn_batch": 1,
    "learn_precision": "float32",
    "learn_steps": 4,
}
TINY_RECIPE = """[recipe]
name = "tiny"
frames = 12
height = 32
width = 32
psnr = 20.0

[[scenes]]
family = "plain"
seeds = [1, 2]

[[scenes]]
family = "plain"
seeds = [3]
split = "val"
"""


ABSENT = {  # without a GPU
    "sensor": {"engine-cuda", "device-cuda", "torch-cuda"},
    "render": {"frame-cuda-fan", "validate-cuda-fan"},
}


@pytest.mark.slow
@pytest.mark.parametrize("section", ["doctor", "equal", "sensor", "render", "steps", "train", "restore", "learn"])
def test_a_section_measures_on_this_machine_at_tiny_sizes(tmp_path, monkeypatch, section):
    """Without a GPU the CPU's form of everything is made, and what needs CUDA is absent with its reason."""
    monkeypatch.syspath_prepend(str(PARTS))
    import pieces

    recipe = tmp_path / "tiny.toml"
    recipe.write_text(TINY_RECIPE)
    sizes = TINY | {"learn_recipe": str(recipe)}
    out = tmp_path / "out"
    code = pieces.main([str(out), "--section", section, "--minutes", "60"], sizes=sizes)
    records = json.loads((out / "table.json").read_text())["records"][section]
    told = {
        n: (r["why"], (out / "log" / f"{section}.{n}.txt").read_text(errors="replace")[-1500:])
        for n, r in records.items()
        if r["state"] not in ("done", "absent")
    }
    assert code == 0, told
    assert not told
    absent = {name: record["why"] for name, record in records.items() if record["state"] == "absent"}
    assert all("CUDA" in why for why in absent.values())
    if not json.loads((out / "machine.json").read_text())["machine"]["gpus"]:
        assert set(absent) == ABSENT.get(section, set())
    rows = {name: record["rows"] for name, record in records.items() if record["state"] == "done"}
    assert rows
    assert all(rows.values())
    assert f"\n## {section}\n\n| " in (out / "table.md").read_text()
    CHECKS[section](rows, out)


def _doctor(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    found = {row["what"]: str(row["found"]) for row in rows["machine"]}
    assert found["Python"] == sys.version.split()[0]
    assert f"torch {torch.__version__}".startswith(found["packages"].partition("torch ")[1])
    assert "works: " in found["scalar_rgb"]
    assert torch.__version__ in found["torch"]


def _sensor(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    for name, found in rows.items():
        for row in found:
            assert row.get("differing per million") in (None, 0), (name, row)
            assert row.get("Gpixel/s", 1) > 0
    assert {row["by"] for found in rows.values() for row in found} >= {"numpy", "llvm", "torch, cpu"}
    assert rows["engine-llvm"][-1]["all checks"] == "passed"
    numpy = rows["engine-llvm"][0]["Gpixel/s"]
    torchs = rows["torch-cpu"][0]["Gpixel/s"]
    assert 0.01 < numpy / torchs < 100  # one unit: both draw one number of Poisson per pixel
    assert list(rows["torch-cpu"][0]) == ["by", "what", "Gpixel/s", "times NumPy", "differing per million"]


def _render(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    assert {row["engine"] for row in rows["engines-fan"]} >= {"llvm", "scalar"}
    assert all(row["equal"] == "yes" for row in rows["engines-fan"])
    assert rows["frame-llvm-fan"][0]["size"] == "16 x 32"
    assert rows["validate-llvm-fan"][0]["asked [dB]"] == 40


def _steps(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    assert {"windows", "batches-11-float32", "batches-12-float32", "compiled"} <= set(rows)
    alone = {row["batch"]: row for row in rows["batches-11-float32"]}
    pairs = {row["batch"]: row for row in rows["batches-12-float32"]}
    for row in (*alone.values(), *pairs.values()):
        assert row["windows per s"] == pytest.approx(row["batch"] * row["steps per s"])
        assert row["share of peak"] > 0
    assert set(alone) == set(pairs) == {1, 2}
    cost = "multiply-adds per restored pixel [M]"
    assert alone[2][cost] == alone[1][cost] > 1.5 * pairs[1][cost]  # two neighbours share work
    assert all(0 < row["share of drawing"] < 0.2 for row in rows["operators"])
    assert [row["compile"] for row in rows["compiled"]] == ["off"]
    assert {row["windows drawn by"]: row["ms of drawing alone"] is not None for row in rows["windows"]} == {
        "device": True,
        "host": False,
    }


def _train(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    from restore import weights_of

    assert rows["data"][0]["clips"] == 2
    assert {"quiver-s-float32", "quiver-s-bfloat16", "mergenet-float32", "mergenet-bfloat16"} <= set(rows)
    for name in set(rows) - {"data", "copies"}:
        assert rows[name][0]["steps"] == TINY["steps"]
        assert rows[name][0]["steps per s"] > 0
    assert weights_of(out, "quiver-s") == (str(out / "runs" / "quiver-s-float32" / "best.safetensors"), "trained here")
    (out / "train" / "mergenet-float32.json").unlink()  # as if killed before the record: the run is finished already
    import pieces

    assert pieces.main([str(out), "--section", "train"], sizes=TINY) == 0
    again = json.loads((out / "train" / "mergenet-float32.json").read_text())["rows"][0]
    assert again["steps"] == TINY["steps"]
    assert again["PSNR matched [dB]"] == rows["mergenet-float32"][0]["PSNR matched [dB]"]


def _restore(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    from quiver.baselines import METHODS

    networks = {name.rpartition("-")[0] for name in set(rows) - set(METHODS)}
    assert set(METHODS) <= set(rows)
    assert {"quiver-s", "quiver", "mergenet", "unet"} <= networks
    largest = {name: found[0].get("largest [% of white]") for name, found in rows.items()}
    errors = {name: (largest[f"{name}-float32"], largest[f"{name}-bfloat16"]) for name in networks}
    for name, (exact, low) in errors.items():
        assert exact < 1e-3, name  # where torch computes on the CPU, it is the same computation
        assert low >= exact, name  # equal where random weights add nothing to the frame
    assert errors["quiver-s"][1] > 1e-3


def _equal(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    assert set(rows) == {"codes", "merge", "classical", "windows", "network"}
    for row in (row for part in rows.values() for row in part):
        (largest,) = (value for name, value in row.items() if name.startswith("largest difference"))
        assert isinstance(largest, float)
        assert largest < 0.1, row


def _learn(rows: dict[str, list[dict[str, object]]], out: Path) -> None:
    assert rows["quiver-s"][0]["steps"] == "4 of 4"
    assert sorted(path.name for path in (out / "keep").iterdir()) == [
        *("history.json", "quiver-s.safetensors.00", "quiver-s.safetensors.01", "schedule.json")
    ]


CHECKS = {
    "doctor": _doctor,
    "equal": _equal,
    "learn": _learn,
    "sensor": _sensor,
    "render": _render,
    "steps": _steps,
    "train": _train,
    "restore": _restore,
}
