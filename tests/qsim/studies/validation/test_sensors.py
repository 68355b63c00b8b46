"""Tests `qsim validate sensor`: a correct program passes; each kind of error is named and sets the exit code."""

import json
from dataclasses import replace

import numpy as np
import pytest

from qsim.cli import program
from qsim.keys import Key
from qsim.sensor.compiled import jit
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.studies.validation import sensors

PIXELS = 1 << 16
MODELS = {**sensors.MODELS}  # all; the report below has two


@pytest.fixture(scope="module")
def report():
    """Return a report of two models; the slow tier runs all."""
    with pytest.MonkeyPatch.context() as patch:
        few = {name: sensors.MODELS[name] for name in ("QIS 3 bits, gain 1", "clocked SPAD, 1 bit")}
        patch.setattr(sensors, "MODELS", few)
        patch.setattr(sensors, "ROUNDS", 1)
        yield sensors.run(PIXELS)


def test_the_report_holds_a_row_for_every_engine_and_is_within_bounds(report):
    assert report.ok
    assert report.pixels == PIXELS
    engines = {(row.model, row.engine) for row in report.rows}
    assert ("QIS 3 bits, gain 1", "numpy") in engines
    assert ("clocked SPAD, 1 bit", "reference") in engines
    assert (("QIS 3 bits, gain 1", "fast") in engines) == jit.available()
    for row in report.rows:
        assert row.megapixels_per_second > 0
        if row.engine == "reference":
            assert row.cdf_error < 1e-10
    json.dumps(report.to_dict())


def test_the_table_names_what_is_outside(report):
    text = "\n".join(sensors.table(report))
    assert "everything is within its bounds" in text
    bad = replace(report.rows[0], wrong=("p", "speed"))
    broken = replace(report, rows=[bad, *report.rows[1:]])
    assert not broken.ok
    assert "OUTSIDE: p, speed" in "\n".join(sensors.table(broken))
    wrong = replace(report, cases=[replace(report.cases[0], ok=False)])
    assert not wrong.ok
    assert "WRONG" in "\n".join(sensors.table(wrong))


GOOD = sensors.SensorRow("m", "fast", 1.0, 30.0, 25.0, 1e-7, 0.5, 0.1, -0.2, 0.0)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"cdf_error": 2e-5}, "cdf error"),
        ({"engine": "reference", "cdf_error": 2e-10}, "cdf error"),
        ({"p_value": 1e-9}, "p"),
        ({"z_mean": 7.0}, "z mean"),
        ({"z_variance": -7.0}, "z variance"),
        ({"mismatches_per_million": 6.0}, "mismatch"),
        ({"times_numpy": 24.0}, "speed"),
    ],
)
def test_each_error_is_named(change, name):
    assert sensors.judged(GOOD, 60, require_speed=True).wrong == ()
    assert sensors.judged(replace(GOOD, **change), 60, require_speed=True).wrong == (name,)
    if name == "speed":
        assert sensors.judged(replace(GOOD, **change), 60, require_speed=False).wrong == ()


def test_a_sensor_that_is_one_percent_off_does_not_pass():
    """Codes of 1 % more light on 2^20 pixels: far outside, by the mean and by chi-square."""
    sensor = QIS(0.8, 1.6, 0.2, 3)
    light = np.full((1024, 1024), 3.25 * 1.01, np.float32)
    codes = sensor.sample(light, sensors.EXPOSURE, key=Key(0, 1))
    p, z_mean, _ = sensors.statistics(codes, sensor, 3.25)
    assert p < 1e-9
    assert z_mean > 7
    codes = sensor.sample(light / np.float32(1.01), sensors.EXPOSURE, key=Key(0, 1))
    p, z_mean, z_variance = sensors.statistics(codes, sensor, 3.25)
    assert p > 1e-6
    assert max(abs(z_mean), abs(z_variance)) < 5


def test_an_impossible_code_does_not_pass():
    """A binary sensor that cannot fire fires 50 times; pooling must not hide it."""
    sensor = BinarySPAD(0.5, 0.0)
    codes = np.zeros(PIXELS, np.uint8)
    codes[:50] = 1
    assert sensors.statistics(codes, sensor, 0.0)[0] == 0.0


def test_the_figure_is_written(report, tmp_path):
    for kind, start in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        path = tmp_path / "new" / f"speed.{kind}"
        sensors.figure(report, path)
        assert path.read_bytes().startswith(start)
    with pytest.raises(ValueError, match=r"speed.txt: a figure is a .png, .svg or .pdf file"):
        sensors.figure(report, tmp_path / "speed.txt")


def test_the_command_prints_json_and_its_exit_code_is_the_verdict(report, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sensors, "run", lambda *_, **__: report)
    assert program.main(["validate", "sensor", "--json", "-o", str(tmp_path / "s.png")]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is True
    assert program.main(["validate", "sensor", "-o", str(tmp_path / "s.png")]) == 2
    assert "exists" in capsys.readouterr().err
    broken = replace(report, cases=[replace(report.cases[0], ok=False)])
    monkeypatch.setattr(sensors, "run", lambda *_, **__: broken)
    assert program.main(["validate", "sensor"]) == 1
    assert "WRONG" in capsys.readouterr().out


def test_too_few_pixels_are_refused():
    with pytest.raises(ValueError, match="at least 65536, got 100"):
        sensors.run(100)


@pytest.mark.slow
def test_the_complete_report_is_within_bounds():
    report = sensors.run(1 << 18)
    assert report.ok, "\n".join(sensors.table(report))


def test_a_name_states_the_gain_of_its_sensor():
    """A QIS beside others must be another sensor: one had the gain 1 of its neighbour."""
    named = {name: sensor for name, (sensor, *_) in MODELS.items() if "gain" in name}
    assert len(named) == 4
    for name, sensor in named.items():
        assert sensor.gain == pytest.approx(float(name.split("gain ")[1]), abs=5e-4)
    assert len(set(named.values())) == len(named)
