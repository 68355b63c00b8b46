"""One readout: its distribution, its information and its estimates are those of the sensor."""

import numpy as np
import pytest

from qsim.sensor.spad import BinarySPAD
from qsim.studies.bit_depth.readout import Readout


def test_binary_read_without_noise_is_a_plane(clip):
    """One bit, one clip frame: a SPAD plane has the information that 1 - exp(-n) allows, the QIS less (read noise)."""
    readout = Readout("planes", 3, BinarySPAD(0.8, 0.0, 1), 1e-4)
    whole = BinarySPAD(0.8, 0.0, 3)
    assert np.allclose(readout.pmf(np.array([0.5, 4.0])), whole.pmf(np.array([0.5, 4.0]), 7e-4))
    theta = 4.0
    assert readout.snr_db(theta) == pytest.approx(
        20 * np.log10(theta * np.sqrt(whole.fisher_information(np.array(theta), 7e-4)))
    )
    assert np.allclose(readout.estimates, whole.maximum_likelihood(np.eye(8), 7e-4).photons, rtol=1e-6)
