"""The study of bit depth with the default restorer: equal light, centred exposures, and a page of what was measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from stats import assert_mean

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import restorer_bits

from qsim.formats.warped_pictures import frame
from qsim.studies.bit_depth import restored_bits


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_exposures_lie_around_the_instant(bits: int):
    """The middle code's exposure has the same light before the instant and after it; shorter codes are sharper."""
    parts = restorer_bits.scene(0, 32, 2.0)
    found = restorer_bits.exposures(parts, 32, bits)
    planes = 2**bits - 1
    times = (np.arange(planes) - planes // 2) / restorer_bits.UNIT
    middle = np.mean([frame(parts, (32, 32), t)[0] for t in times], axis=0)
    np.testing.assert_allclose(found[restorer_bits.WINDOW // 2], middle, rtol=1e-12)
    assert found.shape == (11, 32, 32)


def test_what_rests_is_the_same_in_all_exposures():
    found = restorer_bits.exposures(restorer_bits.scene(1, 32, 0.0), 32, 3)
    np.testing.assert_allclose(found, np.broadcast_to(found[:1], found.shape), rtol=1e-12)


@pytest.mark.parametrize("bits", [1, 3, 5])
def test_all_depths_get_the_same_light_per_plane(bits: int):
    light = np.ones((11, 48, 48))
    codes = restorer_bits.codes_of(light, 0.05, bits, 0)
    planes = 2**bits - 1
    assert codes.exposure == pytest.approx(planes * restorer_bits.PLANE)
    table = codes.sensor.response(codes.exposure)
    drawn = codes.read(0, 11)
    expected = np.interp(0.05 * planes, table.photons, table.mean)
    assert_mean(drawn, expected, float(np.interp(0.05 * planes, table.photons, table.variance)))


def test_the_page_tells_the_best_depth(tmp_path, monkeypatch):
    """Depths, lights and motions of a known table are found again; three bits lose nothing where they are best."""
    monkeypatch.setattr(restorer_bits, "BITS", (1, 3))
    monkeypatch.setattr(restorer_bits, "LIGHTS", (0.5, 2.0))
    monkeypatch.setattr(restorer_bits, "MOTION", (0.0, 4.0))
    still = {"0.5": (20.0, 24.0), "2": (21.0, 26.0)}
    moving = {"0.5": (22.0, 21.5), "2": (25.0, 23.0)}
    rows = {
        motion: [{f"{bits} bits, {p} PPP": {"psnr": told[p][i]} for p in told for i, bits in enumerate((1, 3))}]
        for motion, told in (("0", still), ("4", moving))
    }
    text = restorer_bits.page(restorer_bits.table_of(rows), 1, 32, "0" * 64)
    assert "| 0 | 3 (0.0) | 3 (0.0) |" in text
    assert "| 4 | 1 (0.5) | 1 (2.0) |" in text
    restorer_bits.draw(restorer_bits.table_of(rows), tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 1000


def test_the_program_measures_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(restorer_bits, "BITS", (1, 3))
    monkeypatch.setattr(restorer_bits, "LIGHTS", (2.0,))
    monkeypatch.setattr(restorer_bits, "MOTION", (0.0, 4.0))
    assert restorer_bits.main(["--scenes", "1", "--size", "32", "--out", str(tmp_path / "bits")]) == 0
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".md", ".png"}
    capsys.readouterr()
    assert restorer_bits.main(["--size", "16", "--out", str(tmp_path / "bits")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_tradeoff_quotes_what_the_page_shows():
    """The table in the package is that of the numbers behind the page."""
    stored = json.loads(restorer_bits.DEFAULT.with_suffix(".json").read_bytes())
    made = restorer_bits.of_package(restorer_bits.table_of(stored["motion"]), stored["weights"])
    assert json.loads(restorer_bits.TABLE.read_bytes()) == made
    assert str(restorer_bits.DEFAULT.with_suffix(".md").relative_to(restorer_bits.ROOT)) == restored_bits.PAGE
