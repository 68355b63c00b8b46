"""Tests colour filter arrays: what each pixel collects, the exact law of every colour's codes, phases, mistakes."""

import numpy as np
import pytest
import sensor_cases
from sensor_cases import EXPOSURE
from stats import FALSE_ALARM, assert_histogram

from qsim.keys import Key
from qsim.sensor import colour_filter
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

CROSSED = {"R": (0.5, 0.06, 0.01), "G": (0.05, 0.6, 0.09), "B": (0.01, 0.08, 0.4), "W": (0.7, 0.75, 0.6)}


def random_filter(rng: np.random.Generator) -> ColourFilter:
    """A mask of any size up to 5 x 5 with up to five colours, each with any efficiencies."""
    rows, columns, colours = (int(n) for n in rng.integers(1, 6, 3))
    letters = rng.integers(0, colours, (rows, columns))
    mask = tuple("".join("ABCDE"[i] for i in row) for row in letters)
    chosen = sorted(set("".join(mask)))
    return ColourFilter(mask, {c: tuple(np.clip(rng.uniform(-0.3, 1, 3), 0, 1)) for c in chosen})


def test_every_pixel_collects_what_its_colour_passes():
    """Against a loop over pixels, over random masks, efficiencies, odd sizes and origins of crops."""
    rng = np.random.default_rng(0)
    done = 0
    while done < 40:
        try:
            filters = random_filter(rng)
        except ValueError:  # a colour without any efficiency
            continue
        done += 1
        height, width, y0, x0 = (int(n) for n in rng.integers(1, 12, 4))
        photons = rng.uniform(0, 30, (2, 3, height, width))
        own = float(rng.uniform(0.1, 1))
        found = filters.mosaic(photons, own, (y0, x0))
        for y, x in np.ndindex(height, width):
            colour = filters.mask[(y + y0) % len(filters.mask)][(x + x0) % len(filters.mask[0])]
            electrons = photons[:, :, y, x] @ np.array(filters.efficiency[colour])
            np.testing.assert_allclose(own * found[:, y, x], electrons, rtol=1e-12)
        np.testing.assert_allclose(filters.shifted(y0, x0).mosaic(photons, own), found, rtol=0)


@pytest.mark.parametrize("name", sorted(MASKS))
def test_without_efficiencies_filters_pass_their_band(name):
    photons = np.random.default_rng(1).uniform(0, 9, (3, 7, 9))
    found = ColourFilter(MASKS[name]).mosaic(photons, 0.37)
    for y, x in np.ndindex(7, 9):
        colour = MASKS[name][y % len(MASKS[name])][x % len(MASKS[name][0])]
        expected = photons[:, y, x].sum() if colour == "W" else photons["RGB".index(colour), y, x]
        assert found[y, x] == pytest.approx(expected, rel=1e-12)


@sensor_cases.each
def test_codes_of_each_colour_have_the_law_of_its_efficiency(sensor):
    """The law is that of a sensor without filters whose light gives the colour's electrons; frames of odd size."""
    filters = ColourFilter(("RGW", "BGR"), CROSSED)
    light = np.array([0.9, 2.3, 1.4]) * sensor.white(EXPOSURE) / 6
    photons = np.broadcast_to(light[:, None, None], (3, 61, 73))
    codes = sensor.sample(filters.mosaic(photons, sensor.efficiency), EXPOSURE, key=Key(5, 6))
    letters = np.array([[filters.mask[y % 2][x % 3] for x in range(73)] for y in range(61)])
    for colour, each in CROSSED.items():
        pmf = sensor.pmf(np.array(float(np.dot(each, light)) / sensor.efficiency), EXPOSURE)
        assert_histogram(codes[letters == colour], pmf, false_alarm=FALSE_ALARM, checks=4 * len(sensor_cases.SENSORS))


def test_an_ideal_counter_counts_poisson_photons_of_each_colour():
    """Without noise and dark electrons, mean and variance of a colour's codes are the electrons that it collects."""
    filters = ColourFilter(MASKS["rgbw"], CROSSED)
    photons = np.broadcast_to(np.array([3.0, 5.0, 4.0])[:, None, None], (3, 200, 201))
    codes = QIS(0.8, 0.0, 0.0, 8).sample(filters.mosaic(photons, 0.8), 1e-3, key=Key(1, 2)).astype(float)
    for (y, x), colour in {(0, 0): "R", (0, 1): "G", (1, 0): "W", (1, 1): "B"}.items():
        mean = float(np.dot(CROSSED[colour], [3.0, 5.0, 4.0]))
        each = codes[y::2, x::2]
        assert abs(each.mean() - mean) < 5 * np.sqrt(mean / each.size)
        assert abs(each.var() - mean) < 5 * np.sqrt((mean + 2 * mean**2) / each.size)


def test_engines_agree_on_mosaics():
    """Over random masks, sensors and light, at odd sizes and origins: the compiled codes are the reference's."""
    rng = np.random.default_rng(2)
    differ = 0
    total = 0
    for trial in range(6):
        filters = ColourFilter(MASKS[TILES[trial % 3]], None if trial % 2 else CROSSED_OF[trial % 3])
        sensor = (QIS(0.7, 5.0, float(rng.uniform(0, 0.5)), 3), BinarySPAD(0.4, 100.0))[trial % 2]
        photons = rng.gamma(1.0, float(rng.uniform(0.2, 6)), (2, 3, 131, 77)).astype(np.float32)
        light = filters.mosaic(photons, sensor.efficiency, (3, 5))
        one, two = (sensor.sample(light, EXPOSURE, key=Key(trial, 9), engine=e) for e in ("reference", "fast"))
        differ = differ + int((one != two).sum())
        total = total + one.size
    assert differ <= 5e-6 * total


TILES = ("rggb", "quad", "rgbw")
CROSSED_OF = [{c: CROSSED[c] for c in sorted(set("".join(MASKS[name])))} for name in TILES]


def test_tables_are_read_as_they_are_written(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        '[colour]\nmask = ["RG", "WB"]\nefficiency.R = 0.5\nefficiency.G = [0.1, 0.6, 0.1]\n'
        "efficiency.B = 0.4\nefficiency.W = [0.7, 0.7, 0.6]\n"
    )
    found = colour_filter.load(path)
    assert found.mask == ("RG", "WB")
    assert found.efficiency == {"R": (0.5, 0, 0), "G": (0.1, 0.6, 0.1), "B": (0, 0, 0.4), "W": (0.7, 0.7, 0.6)}
    assert colour_filter.from_dict(found.to_dict()) == found
    assert colour_filter.load("quad").tile == (4, 4)


MISTAKES = [
    ({"mask": ["RG", "GBB"]}, "does not tile, rows need equally many letters"),
    ({"mask": []}, "does not tile.*no row"),
    ({"mask": "bayer"}, "mask is one of rggb, quad, rgbw, red, green, blue or rows of letters"),
    ({"mask": ["RC"]}, r"colour C of the mask has none; give efficiency\.C"),
    ({"mask": "rggb", "efficiency": {"R": 0.5, "G": 0.5}}, r"colour B of the mask has none; give efficiency\.B"),
    ({"mask": ["R"], "efficiency": {"R": 0.5, "W": [1, 1, 1]}}, r"efficiency\.W: the mask has no such colour"),
    ({"mask": ["W"], "efficiency": {"W": 0.5}}, r"efficiency\.W: three numbers are needed, for photons of R, G and B"),
    ({"mask": ["R"], "efficiency": {"R": 1.5}}, "three numbers from 0 to 1, one above 0"),
    ({"mask": ["R"], "efficiency": {"R": 0.0}}, "three numbers from 0 to 1, one above 0"),
    ({"mask": ["R"], "efficiency": 0.5}, "efficiency: expected a table of values, got 0.5"),
    ({"mask": ["R"], "efficiency": {"R": [0.5, 0.1]}}, r"efficiency\.R: expected a number, or a list of"),
    ({"mask": ["R"], "masks": 1}, "unknown key 'masks'"),
    ({"tile": 1}, "a table with mask"),
]


@pytest.mark.parametrize(("table", "why"), MISTAKES)
def test_mistakes_are_named(table, why):
    with pytest.raises(ValueError, match=f"colour: .*{why}"):
        colour_filter.from_dict(table)


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown colour filter array 'rgbb'"):
        colour_filter.load("rgbb")
    (tmp_path / "none.toml").write_text("[sensor]\n")
    with pytest.raises(ValueError, match=r"has no table \[colour\]"):
        colour_filter.load(tmp_path / "none.toml")
