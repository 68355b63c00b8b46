"""Tests streams behind colour filters: stored codes and descriptions, replay, redrawing, crops, groups, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from clips import colour_clip, write_clip
from PIL import Image

from qsim.cli import main
from qsim.dataset.checking import redraw
from qsim.dataset.recipe import load
from qsim.keys import Key, hash_name
from qsim.optics.radiometry import RGB
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.preparation import assemble, prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense, stored

SENSOR = """
[sensor]
model = "QIS"
quantum_efficiency = 0.8
dark_current = 5.0
read_noise = 0.2
bits = 3
[colour]
mask = ["RG", "WB"]
efficiency.R = 0.5
efficiency.G = [0.1, 0.6, 0.1]
efficiency.B = 0.4
efficiency.W = [0.7, 0.7, 0.6]
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(SENSOR)
    return tmp_path


def test_a_stream_is_one_mosaic_that_can_be_drawn_again(place):
    clip = colour_clip(place / "c")
    stream = clip.sense("mine.toml", ppp=4.0)
    assert stream.shape == clip.shape == (3, 7, 9)
    light = 4.0 / clip.mean_photons
    expected = stream.colour_filter.mosaic(np.stack([clip_photons(clip, t, light) for t in range(3)]), 0.8)
    drawn = stream.sensor.sample(expected, clip.exposure, key=Key(0, hash_name("c")), engine="reference")
    np.testing.assert_array_equal(stream.codes(), drawn)
    for one, kept in (replay(clip, stream, t) for t in range(3)):
        np.testing.assert_array_equal(one, kept)
    assert [found.line() for found in redraw(place / "c")] == [None]
    assert stream.truth().shape == (3, 3, 7, 9)
    assert stream.truth().mean() == pytest.approx(4.0, rel=1e-3)
    assert clip.sense("mine.toml", ppp=4.0).info == stream.info, "kept, not drawn again"


def test_a_given_sensor_needs_no_file(place):
    """Neither for its parameters nor for colour filters, of which it has none."""
    clip = write_clip(place / "g")
    own = QIS(0.8, 1.6, 0.2, 3)
    for file in ("gone.toml", "mine.toml"):
        draw = assemble(clip, Sensing(file, ppp=3.0), None, own)
        assert (draw.sensor, draw.colour) == (own, None)


def test_crops_keep_the_phase_of_the_mask(place):
    """A clip that is a window of the frame sees the filters, and the lens, of its place."""
    whole = colour_clip(place / "c", frames=1, height=9, width=11)
    meta = {"camera": whole.info.camera, "origin": [3, 2]}
    window = write_clip(place / "w", radiance=whole.radiance(0)[None, :, 3:8, 2:9], bands=whole.info.bands, **meta)
    wanted = Sensing("mine.toml")
    one = prepare(whole, wanted)
    other = prepare(window, wanted)
    np.testing.assert_allclose(other.light(window, 0, 1), one.light(whole, 0, 1)[:, 3:8, 2:9], rtol=1e-12)
    np.testing.assert_array_equal(one.incident(whole, 0, (3, 2, 5, 7)), one.light(whole, 0, 1)[0, 3:8, 2:9])
    assert window.sense("mine.toml").colour_filter.mask == ("WB", "RG")


def test_slices_and_defects_see_the_filtered_light(place):
    clip = colour_clip(place / "c", frames=4, shutter=1.0)
    counting = CountingSPAD(0.5, 200.0, 1e-5, 4)
    stream = clip.sense(counting, ppp=3.0, slices=2, colour="rggb")
    again = replace(stored(stream), engine="reference").frames(clip, 0, 2)
    np.testing.assert_array_equal(stream.codes(), again)
    (place / "bad.toml").write_text("[defects]\ndevice_seed = 3\ndead = 0.2\nprnu = 0.1\n")
    bad = clip.sense("mine.toml", ppp=3.0, defects="bad.toml", name="bad")
    np.testing.assert_array_equal(bad.codes(), replace(stored(bad), engine="reference").frames(clip, 0, 4))
    planes = clip.sense("spad-320x240", ppp=2.0, bits=2, group=True, colour="quad")
    assert planes.shape == (1, 7, 9)
    np.testing.assert_array_equal(planes.codes(), stored(planes).frames(clip, 0, 1))


def test_light_behind_a_filter_is_that_of_its_band(place):
    """An ideal counter of many frames at rest: the mean code of each pixel is the photons of its band."""
    still = np.repeat(np.random.default_rng(0).uniform(0.2, 2, (1, 3, 7, 9)), 150, axis=0)
    clip = write_clip(place / "c", radiance=still.astype(np.float32), bands=[6.1e-7, 5.4e-7, 4.6e-7])
    stream = clip.sense(QIS(1.0, 0.0, 0.0, 8), ppp=5.0, colour=ColourFilter(("RG", "GB")))
    truth = stream.truth(0, 1)[0]
    mean = stream.codes().mean(axis=0)
    own = np.array([[truth["RGB".index("RGGB"[2 * (y % 2) + x % 2]), y, x] for x in range(9)] for y in range(7)])
    assert (np.abs(mean - own) < 5 * np.sqrt(own / 150)).all()


def test_rows_at_their_own_time_keep_their_filters(place):
    """A code is that of a clip in which every row was taken at its time: light first, then filters."""
    clip = colour_clip(place / "c", frames=6, shutter=1.0)
    late = 0.5 / 2000 / 7  # s
    stream = clip.sense("mine.toml", ppp=4.0, row_delay=late)
    light = prepare(clip, Sensing("mine.toml", ppp=4.0, row_delay=late)).light(clip, 0, 2)
    for t, y in np.ndindex(2, 7):
        share = y * 0.5 / 7
        photons = [clip_photons(clip, t + ahead, stream.photons_factor)[:, y : y + 1] for ahead in (0, 1)]
        mixed = (1 - share) * photons[0] + share * photons[1]
        np.testing.assert_allclose(light[t, y], stream.colour_filter.mosaic(mixed, 0.8, (y, 0))[0], rtol=1e-9)
    assert stream.truth().shape == (len(stream), 3, 7, 9)
    np.testing.assert_array_equal(replay(clip, stream, 1)[0], stream.codes(1, 2)[0])


def test_three_filters_over_all_pixels_are_three_bands(place):
    """The layout of the challenge: one stream per band; its picture has the colours of the last plane."""
    from qsim.formats.challenge import picture

    clip = colour_clip(place / "c", frames=4)
    for seed, name in enumerate(("red", "green", "blue")):
        clip.sense("spad512s", ppp=0.4, bits=1, colour=name, name=name, seed=seed)
    assert main(["convert", "c", "cubes", "--to", "challenge", "--window", "4"]) == 0
    truth = clip.stream("red").truth(3, 4)[0]
    np.testing.assert_array_equal(clip.stream("blue").truth(3, 4)[0], truth)
    with Image.open(next((place / "cubes").glob("*.png"))) as opened:
        np.testing.assert_array_equal(opened, picture(np.moveaxis(truth, 0, -1) * 0.5 / 0.5))


REFUSED = [
    ("sense c --ppp 3", "has three bands and quiver-physical no colour filters"),
    ("sense g --ppp 3 --colour rggb", "has one band, and the sensor has colour filters"),
    ("sense g --ppp 3 --sensor mine.toml", "has one band, and the sensor has colour filters"),
    ("sense c --ppp 3 --colour rgbb", "unknown colour filter array 'rgbb'"),
    ("sense c --ppp 3 --colour torn.toml", "does not tile"),
    ("sense c --ppp 3 --colour blind.toml", "colour B of the mask has none"),
]


@pytest.mark.parametrize(("line", "why"), REFUSED)
def test_mistakes_take_one_line(place, capsys, line, why):
    colour_clip(place / "c")
    write_clip(place / "g", frames=3, height=7, width=9)
    (place / "torn.toml").write_text('[colour]\nmask = ["RG", "GBB"]\n')
    (place / "blind.toml").write_text('[colour]\nmask = "rggb"\nefficiency.R = 0.5\nefficiency.G = 0.5\n')
    assert main(line.split()) == 2
    error = capsys.readouterr().err.strip()
    assert why in error
    assert len(error.splitlines()) == 1
    assert not Clip.open(place / "c").streams
    assert not Clip.open(place / "g").streams


def test_a_recipe_names_its_filters(place):
    from qsim.dataset import recipe

    head = '[recipe]\nname = "t"\nframes = 2\nheight = 8\nwidth = 9\nbands = "rgb"\n[[scenes]]\nfamily = "fan"\n'
    found = recipe.parse(head + '[[streams]]\nsensor = "quiver-physical"\nppp = 3\nbits = 3\ncolour = "quad"\n')
    (job,) = found.jobs
    assert job.settings.bands == "rgb"
    assert job.streams[0].stream_name == "quiver-physical-quad_3bit_3ppp"
    grey = recipe.parse(head.replace('bands = "rgb"\n', ""))
    assert grey.jobs[0].digest != recipe.parse(head).jobs[0].digest
    colour = '[[streams]]\nsensor = "quiver-physical"\nppp = 3\ncolour = "rggb"\n'
    with pytest.raises(ValueError, match="quiver-physical-rggb_3ppp: has one band, and the sensor has colour filters"):
        recipe.parse(head.replace('bands = "rgb"\n', "") + colour)
    with pytest.raises(
        ValueError, match=r"recipe\.toml: streams\[0\] of scenes\[0\]: .*unknown colour filter array 'x'"
    ):
        recipe.parse(head + '[[streams]]\nsensor = "quiver-physical"\nppp = 3\ncolour = "x"\n')


CURVE = [[460e-9, 0.20], [540e-9, 0.50], [610e-9, 0.35]]
WARM = f"""
[sensor]
model = "BinarySPAD"
bits = 1
dark_count_rate = 100.0
dark_doubling = 8.0
dark_reference = 25.0
qe_curve = {CURVE}
"""
RECIPE = """
[recipe]
name = "warm"
bands = "rgb"
frames = 40
height = 24
width = 32
frame_rate = 2000.0
[[scenes]]
family = "fan"
seeds = [1]
[[streams]]
sensor = "warm.toml"
colour = "rggb"
ppp = 1.0
temperature = 41.0
"""


def test_a_recipe_reads_a_curve_of_efficiency_and_a_temperature(tmp_path):
    """Even light of one photon per band: means behind the filters follow the curve, and 400 dark counts per second.

    A filter passes all light of its band, to the efficiency of the curve at the wavelength of the band. Four sigma.
    """
    (tmp_path / "warm.toml").write_text(WARM)
    (tmp_path / "recipe.toml").write_text(RECIPE)
    (wanted,) = load(tmp_path / "recipe.toml").jobs[0].streams
    clip = write_clip(tmp_path / "c", radiance=np.ones((40, 3, 24, 32), np.float32), bands=list(RGB))
    stream, _ = sense(clip, wanted)
    assert stream.info.temperature == 41.0
    points, values = np.array(CURVE).T
    for pixels, band in ((np.s_[::2, ::2], 0), (np.s_[::2, 1::2], 1), (np.s_[1::2, 1::2], 2)):
        codes = stream.codes()[:, *pixels]
        expected = -np.expm1(-(np.interp(RGB[band], points, values) + 400.0 * clip.exposure))
        assert abs(codes.mean() - expected) < 4 * np.sqrt(expected * (1 - expected) / codes.size)
