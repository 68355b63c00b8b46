"""Tests that a readout has the distribution, information and estimates of its sensor."""

import numpy as np
import pytest

from qsim.sensor.spad import BinarySPAD
from qsim.studies.bit_depth.readout import Readout


def test_a_readout_of_planes_is_the_spad_that_sums_them():
    """Three bits of binary planes are a clocked SPAD of seven planes: distribution, information, estimates."""
    readout = Readout("planes", 3, BinarySPAD(0.8, 0.0, 1), 1e-4)
    summed = BinarySPAD(0.8, 0.0, 3)
    assert np.allclose(readout.pmf(np.array([0.5, 4.0])), summed.pmf(np.array([0.5, 4.0]), 7e-4))
    theta = 4.0
    assert readout.snr_db(theta) == pytest.approx(
        20 * np.log10(theta * np.sqrt(summed.fisher_information(np.array(theta), 7e-4)))
    )
    assert np.allclose(readout.estimates, summed.maximum_likelihood(np.eye(8), 7e-4).photons, rtol=1e-6)
