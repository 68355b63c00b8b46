"""Tests the comparison of backends: those that work here agree, and a difference of means fails."""

from __future__ import annotations

from dataclasses import replace

import pytest

from qsim import backend as engine
from qsim.studies.validation.backends import DEVIATIONS, BackendReport, BackendRow, run, table


def test_backends_that_work_here_agree():
    report = run(["plain"], height=24, width=32, seed=3)
    assert {row.engine for row in report.rows} | set(report.missing) == set(engine.BACKENDS)
    assert "scalar" in {row.engine for row in report.rows}
    assert report.ok, table(report)
    assert all(row.mean > 0 and row.seconds > 0 and 0 < row.mean_error < 0.1 * row.mean for row in report.rows)
    assert all((row.outside is None) == (row.engine == "scalar") for row in report.rows)
    assert all(0 < row.outside < 1 for row in report.rows if row.outside is not None)
    for backend, why in report.missing.items():
        assert f"{backend}: {why}" in table(report)


def test_a_difference_of_means_fails():
    plain = BackendRow("scalar", "fan", 2.0, None, 1.0, 0.003)
    other = BackendRow("cuda", "fan", 0.5, 0.08, 1.0 + 0.9 * DEVIATIONS * 0.005, 0.004)
    good = BackendReport(8, 8, 32, (other, plain), {})
    assert good.ok
    assert good.to_dict()["rows"][0]["deviation"] == pytest.approx(0.9 * DEVIATIONS)
    assert good.to_dict()["rows"][0]["ratio"] == 4
    bad = replace(good, rows=(replace(other, mean=1.0 + 1.1 * DEVIATIONS * 0.005), plain))
    assert not bad.ok
    assert "standard errors: NO" in table(bad)
