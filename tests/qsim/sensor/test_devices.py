"""Named sensors: the numbers of the QUIVER table, sources for every field, and strict TOML files."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest

from qsim.sensor.counting import CountingSPAD
from qsim.sensor.devices import (
    DEVICES,
    MODELS,
    from_dict,
    from_toml,
    listing,
    load,
    quiver_paper,
    quiver_physical,
    quiver_published,
)
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

EXPOSURE = 5e-4  # s, 2000 frames per second

# quiver/spec of the paper and its program: (profile, PPP) -> gain, mean electrons, mean code / 7, std of code, P(7)
FLAT_FIELDS = [
    ("published", 3.25, 1.0769, 4.20, 0.607, 1.91, 0.182),
    ("paper", 3.25, 1.0, 2.60, 0.371, 1.59, 0.017),
    ("published", 4.9, 0.7143, 5.52, 0.558, 1.62, 0.071),
    ("paper", 4.9, 1.0, 3.92, 0.549, 1.81, 0.103),
    ("published", 9.75, 0.3590, 9.40, 0.484, 1.14, 0.005),
    ("paper", 9.75, 1.0, 7.80, 0.896, 1.24, 0.66),
    ("published", 26.0, 0.1346, 22.4, 0.431, 0.70, 0.0),
    ("paper", 19.5, 1.0, 15.6, 0.999, 0.12, 0.995),
]


@pytest.mark.parametrize(("profile", "ppp", "gain", "electrons", "mean", "std", "top"), FLAT_FIELDS)
def test_profiles_give_the_flat_fields_of_the_specification(profile, ppp, gain, electrons, mean, std, top):
    """The specification rounds to the last digit written, so half of that digit is the tolerance."""
    sensor = quiver_published(ppp) if profile == "published" else quiver_paper()
    light = np.array(ppp)
    assert sensor.gain == pytest.approx(gain, abs=5e-5)
    assert float(sensor.arrivals(light, EXPOSURE)) == pytest.approx(electrons, rel=0.006)
    assert float(sensor.mean(light, EXPOSURE)) / 7 == pytest.approx(mean, abs=5e-4)
    assert float(np.sqrt(sensor.variance(light, EXPOSURE))) == pytest.approx(std, abs=5e-3)
    assert float(np.exp(sensor.log_pmf(light, EXPOSURE))[7]) == pytest.approx(top, abs=5e-3 if top == 0.66 else 6e-4)


def test_the_profiles_differ_only_in_dark_current_and_gain():
    published = quiver_published(9.75)
    physical = quiver_physical(9.75)
    paper = quiver_paper()
    assert published.dark_current == pytest.approx(3200)
    assert replace(published, dark_current=1.6) == physical
    assert replace(physical, gain=1.0) == paper


def test_published_dark_electrons_are_per_frame_at_any_exposure():
    for exposure in (1e-4, 5e-4, 1 / 30):
        sensor = load("quiver-published", ppp=3.25, exposure=exposure)
        assert float(sensor.arrivals(np.zeros(()), exposure)) == pytest.approx(1.6)


@pytest.mark.parametrize("bits", range(1, 9))
def test_the_gain_rule_puts_the_light_level_on_half_of_the_range_and_never_above_one_code_per_electron(bits):
    """`white` is 2 PPP / QE at every depth, but at least the range itself, (2^b - 1) / QE."""
    for ppp in np.random.default_rng(bits).uniform(0.05, 200, 50):
        published = quiver_published(ppp, bits)
        physical = quiver_physical(ppp, bits)
        assert published.gain == pytest.approx(0.5 * (2**bits - 1) / ppp)
        assert physical.gain == min(published.gain, 1.0)
        assert physical.white(EXPOSURE) == pytest.approx(max(2 * ppp, 2**bits - 1) / 0.8)


def test_a_little_light_uses_more_than_two_codes():
    """At 0.5 PPP and 3 bits, one electron has code 1; with seven codes per electron it has code 7, as two have."""
    sensor = replace(quiver_physical(0.5), read_noise=0.0)
    law = sensor.pmf(1.25, EXPOSURE)
    wasteful = replace(sensor, gain=7.0).pmf(1.25, EXPOSURE)
    assert sensor.gain == 1.0
    np.testing.assert_allclose(law[1:3] / law[0], [1.0, 0.5], rtol=0.01)
    assert wasteful[1:7].sum() < 1e-9


def test_every_device_can_be_made_and_states_a_source_for_each_of_its_numbers():
    for name, device in DEVICES.items():
        sensor = load(name, ppp=3.25)
        assert name == device.name
        assert sensor.bits == device.bits
        assert from_dict(sensor.to_dict()) == sensor
        stated = {f.name for f in fields(sensor) if f.name != "bits" and getattr(sensor, f.name) != f.default}
        assert stated <= set(device.sources), f"{name}: no source for {stated - set(device.sources)}"
        assert set(device.sources) <= {f.name for f in fields(sensor)}


def test_bits_replace_a_devices_own_depth():
    assert load("spad-320x240", bits=3) == BinarySPAD(1.0, 0.0, 3)
    assert load("cmos-5.1e", bits=12).levels == 4096


@pytest.mark.parametrize("bits", [1, 3, 7])
def test_black_of_the_conventional_pixel_needs_eight_bits(bits):
    """Its offset is 32 codes: with few bits every code would be the top one."""
    with pytest.raises(ValueError, match=r"cmos-5\.1e: black is at code 32; give 8 bits or more"):
        load("cmos-5.1e", bits=bits)
    dark = load("cmos-5.1e", bits=8).mean(np.zeros(1), EXPOSURE)
    assert float(dark[0]) == pytest.approx(32, abs=0.01)


def test_the_listing_is_plain_data_with_one_row_per_device():
    import json

    rows = json.loads(json.dumps(listing()))
    assert [row["name"] for row in rows] == list(DEVICES)
    assert all(row["settings"]["model"] in MODELS for row in rows)


@pytest.mark.parametrize(
    "sensor",
    [
        QIS(0.8, 1.6, 0.2, 3, gain=1.1, offset=-0.25, full_well=200.0),
        QIS(0.8, 1.6, 0.2, 3),
        BinarySPAD(0.3, 25.0, 3),
        CountingSPAD(0.35, 25.0, 35e-9, 8, paralyzable=True),
    ],
)
def test_a_sensor_survives_its_dictionary(sensor):
    assert from_dict(sensor.to_dict()) == sensor


def test_a_users_file_has_the_fields_of_the_sensor(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 2\nread_noise = 0.2\nbits = 3\n'
        '[sources]\nread_noise = "photon transfer, 25 C"\n'
    )
    assert load(path) == load(str(path)) == QIS(0.8, 2.0, 0.2, 3)
    assert load(path, bits=3) == load(path)


GOOD = {"model": '"BinarySPAD"', "pde": "0.3", "dark_count_rate": "25", "bits": "1"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"pdee": "0.3"}, "mine.toml: [sensor]: unknown key 'pdee' (did you mean 'pde'?)"),
        ({"model": '"BinarySpad"'}, "got 'BinarySpad' (did you mean 'BinarySPAD'?)"),
        ({"pde": None}, "mine.toml: [sensor]: key 'pde' is missing"),
        ({"pde": '"0.3"'}, "pde: expected a number, got '0.3'"),
        ({"bits": "1.0"}, "bits: expected a whole number, got 1.0"),
        ({"bits": "true"}, "bits: expected a whole number, got True"),
        ({"pde": "1.5"}, "BinarySPAD.pde"),
        ({"pde": "nan"}, "BinarySPAD.pde"),
        ({"[source]\nx": "1"}, "unknown table [source] (did you mean 'sources'?)"),
        ({"[sources]\npd": '"x"'}, "unknown key 'pd' in [sources] (did you mean 'pde'?)"),
        ({"pde": "="}, "mine.toml:3: not valid TOML"),
    ],
)
def test_a_wrong_file_is_refused_with_what_and_where(tmp_path, change, text):
    path = tmp_path / "mine.toml"
    entries = {key: value for key, value in (GOOD | change).items() if value is not None}
    path.write_text("[sensor]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items()))
    with pytest.raises(ValueError, match=re.escape(text)):
        from_toml(path)


def test_other_mistakes_say_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="unknown sensor 'quiver-phisical' \\(did you mean 'quiver-physical'"):
        load("quiver-phisical")
    with pytest.raises(ValueError, match="give the photons per pixel"):
        load("quiver-physical")
    with pytest.raises(ValueError, match="photons per pixel above 0, got 0"):
        load("quiver-physical", ppp=0)
    with pytest.raises(FileNotFoundError, match="no such sensor file"):
        load(tmp_path / "absent.toml")
    path = tmp_path / "mine.toml"
    path.write_text("[sensor]\n" + "".join(f"{key} = {value}\n" for key, value in GOOD.items()))
    with pytest.raises(ValueError, match="the file has bits = 1, the request 3"):
        load(path, bits=3)


CAMERA = """[sensor]
model = "QIS"
quantum_efficiency = 0.6
dark_current = 100.0
read_noise = 5.0
full_well = {well}
bits = {bits}
offset = {offset}
iso = {iso}
[sources]
iso = "chosen"
"""


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
@pytest.mark.parametrize("iso", [100, 200, 3200.0])
@pytest.mark.parametrize("offset", [0.0, 16.5])
def test_iso_is_a_gain_at_which_a_share_of_the_full_well_fills_the_code(tmp_path, bits, iso, offset):
    (tmp_path / "c.toml").write_text(CAMERA.format(well=8000.0, bits=bits, offset=offset, iso=iso))
    sensor = load(tmp_path / "c.toml")
    electrons = np.array([8000.0 * 100 / iso])
    assert sensor.gain * electrons[0] + offset == pytest.approx(2**bits - 1)
    assert int(sensor.codes_of(electrons)[0]) == 2**bits - 1
    assert from_dict(sensor.to_dict()) == sensor


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("iso = 100", "iso = 0", "iso needs a full_well above 0"),
        ("iso = 100", "iso = -1", "iso needs a full_well above 0"),
        ("iso = 100", "iso = inf", "iso needs a full_well above 0"),
        ("iso = 100", "iso = nan", "iso needs a full_well above 0"),
        ("iso = 100", 'iso = "high"', "iso is a number, got 'high'"),
        ("iso = 100", "iso = true", "iso is a number, got True"),
        ("iso = 100", "iso = 100\ngain = 1.0", "leave one of iso and gain out"),
        ('"QIS"', '"SpikeCamera"', "iso states the gain of a QIS"),
        ("bits = 12\n", "", "states no bits, so it serves every depth; say which one"),
        ("full_well = 8000.0\n", "", "iso needs a full_well above 0"),
        ("offset = 0.0", "offset = 5000.0", "codes above the offset"),
        ("bits = 12", "bits = 99999999999", "bits"),
    ],
)
def test_an_iso_that_states_no_gain_is_refused(tmp_path, old, new, message):
    text = CAMERA.format(well=8000.0, bits=12, offset=0.0, iso=100)
    assert old in text
    (tmp_path / "c.toml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message) as caught:
        load(tmp_path / "c.toml")
    assert "\n" not in str(caught.value)


def test_a_file_without_bits_serves_every_depth(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text('[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 20\n')
    for bits in (1, 3, 8):
        assert load(path, bits=bits) == BinarySPAD(0.4, 20.0, bits)
    with pytest.raises(ValueError, match=r"camera\.toml: states no bits, so it serves every depth; say which one"):
        load(path)
