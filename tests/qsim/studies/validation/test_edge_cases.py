"""Tests the edge cases of every sensor model: all are right, and a wrong distribution is found."""

from qsim.sensor.qis import QIS
from qsim.studies.validation.edge_cases import hard_cases
from qsim.studies.validation.sensors import EXPOSURE, MODELS


def test_every_hard_case_is_right():
    cases = hard_cases({name: model[0] for name, model in MODELS.items()}, EXPOSURE)
    assert len(cases) > 20
    assert [case.name for case in cases if not case.ok] == []


def test_a_distribution_that_sums_to_less_than_one_is_found():
    class Leaking(QIS):
        def log_pmf(self, photons, exposure, wanted=None):
            return super().log_pmf(photons, exposure, wanted) - 1e-6

    wrong = [case.name for case in hard_cases({"leak": Leaking(0.8, 1.6, 0.2, 3)}, EXPOSURE) if not case.ok]
    assert wrong == ["leak: light 0 ... 1e12"]
