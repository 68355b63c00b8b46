"""Tests that a readout has the distribution, information and estimates of its sensor."""

import numpy as np
import pytest

from qsim.sensor.spad import BinarySPAD
from qsim.studies.bit_depth.readout import Readout, StudySettings, plane_sensor, readouts

SPAD = '[sensor]\nmodel = "BinarySPAD"\npde = 0.3\ndark_count_rate = 25.0\nbits = 4\n'
COUNTER = '[sensor]\nmodel = "CountingSPAD"\npde = 0.3\ndark_count_rate = 25.0\ndead_time = 5e-8\nbits = 8\n'
QIS = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.3\ndark_current = 25.0\nread_noise = 0.2\nbits = 3\n'
SPIKE = '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.6\ndark_current = 100.0\nthreshold = 1000\n'


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


@pytest.mark.parametrize("text", [SPAD, COUNTER, QIS])
def test_a_sensor_file_is_read_at_every_depth(tmp_path, text):
    """Its bits do not matter; a plane has its efficiency and dark rate."""
    file = str(tmp_path / "mine.toml")
    (tmp_path / "mine.toml").write_text(text)
    settings = StudySettings(bits=(1, 3, 5), sensor=file)
    forms = [form for form in readouts(settings, 0.65, 1e-4) if form.model == "multibit"]
    assert [form.sensor.bits for form in forms] == [1, 3, 5]
    assert {(form.sensor.efficiency, form.sensor.dark_rate) for form in forms} == {(0.3, 25.0)}
    assert plane_sensor(settings, 0.65, 1e-4) == BinarySPAD(0.3, 25.0, 1)
    plane = plane_sensor(StudySettings(plane=file), 0.65, 1e-4)
    assert (plane.bits, plane.efficiency) == (1, 0.3)


def test_a_temperature_doubles_the_dark_rate_of_both_reads(tmp_path):
    """Two doublings, of a file that states no bits."""
    file = tmp_path / "warm.toml"
    own = SPAD.replace("bits = 4\n", "")
    assert "bits" not in own
    file.write_text(f"{own}dark_doubling = 8.0\ndark_reference = 25.0\n")
    settings = StudySettings(bits=(2,), sensor=str(file), temperature=41.0)
    planes, multibit = readouts(settings, 0.65, 1e-4)
    assert planes.sensor.dark_rate == multibit.sensor.dark_rate == 100.0
    with pytest.raises(ValueError, match="temperature 41: quiver-physical has no law of temperature"):
        StudySettings(temperature=41.0)


@pytest.mark.parametrize("own", ["gain = 1.08\n", "offset = 2.0\n", "full_well = 100.0\niso = 400\n"])
def test_a_gain_belongs_to_the_bits_of_its_file(tmp_path, own):
    """The refusal names the depth at which the file is taken."""
    file = str(tmp_path / "mine.toml")
    (tmp_path / "mine.toml").write_text(QIS + own)
    with pytest.raises(ValueError, match=r"belong to its 3 bits, and 1 are asked for; .* alone: bits=3$"):
        readouts(StudySettings(sensor=file), 0.65, 1e-4)
    planes, multibit = readouts(StudySettings(bits=(3,), sensor=file), 0.65, 1e-4)
    assert planes.sensor == BinarySPAD(0.3, 25.0, 1)
    assert multibit.sensor.bits == 3
    with pytest.raises(ValueError, match="belong to its 3 bits, and 1 are asked for"):
        plane_sensor(StudySettings(plane=file), 0.65, 1e-4)


@pytest.mark.parametrize("name", ["sensor", "plane"])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{SPAD}[defects]\nprnu = 0.02\n", r"perfect pixels .* name a file without the table \[defects\]"),
        (f'{SPAD}[colour]\nmask = "rggb"\n', r"perfect pixels .* name a file without the table \[colour\]"),
        (SPIKE, "planes of a spike camera depend on each other, which this study does not model"),
    ],
)
def test_sensors_that_the_laws_do_not_hold_for_are_refused(tmp_path, name, text, message):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ValueError, match=rf"mine\.toml: .*{message}"):
        readouts(StudySettings(**{name: str(tmp_path / "mine.toml")}), 0.65, 1e-4)


def test_a_table_of_defects_without_any_is_a_perfect_sensor(tmp_path):
    (tmp_path / "mine.toml").write_text(f"{SPAD}[defects]\nprnu = 0.0\n")
    assert readouts(StudySettings(bits=(2,), sensor=str(tmp_path / "mine.toml")), 0.65, 1e-4)[1].sensor.bits == 2


def test_a_conventional_pixel_is_compared_with_planes_of_its_efficiency():
    planes, multibit = readouts(StudySettings(bits=(9,), sensor="cmos-5.1e"), 0.65, 1e-4)
    assert planes.sensor == BinarySPAD(0.8, 1.6, 1)
    assert multibit.sensor.bits == 9
