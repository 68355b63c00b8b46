"""The names for notebooks: `import qsim` stays quick, reprs show shapes and units, `quiver.restore` is one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import fakes
import numpy as np
import pytest
from clips import write_clip

import qsim
import quiver
from qsim import QIS, BinarySPAD, CountingSPAD, Dataset, Scene, Sensing, sense
from qsim.dataset import generation, recipe
from qsim.optics.camera import Camera
from qsim.scene import Constant

ROOT = Path(__file__).parents[2]


def test_every_name_is_there_and_nothing_else():
    for module in (qsim, quiver):
        for name in module.__all__:
            assert callable(getattr(module, name))
            assert name in dir(module)
        with pytest.raises(AttributeError, match="no attribute 'Clop'"):
            module.Clop  # noqa: B018


def test_importing_qsim_takes_little_more_than_numpy():
    """In processor time, as a multiple of the import of NumPy in the same process; the best of three."""
    code = (
        "import time; t = time.process_time; a = t(); import numpy; b = t(); import qsim; c = t();"
        "print((c - b) / (b - a))"
    )
    ratios = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout)
        for _ in range(3)
    ]
    assert min(ratios) < 1.5


def test_reprs_show_shapes_and_units(tmp_path):
    clip = write_clip(tmp_path / "fan_0003", frames=3, height=8, width=10)
    assert repr(clip).startswith("<Clip fan_0003: 3 frames of 8 x 10 px at 2000 fps, exposure 500 us, mean radiance ")
    assert "W/m2/sr, streams: none>" in repr(clip)
    stream, _ = sense(clip, Sensing("quiver-physical", 3, ppp=3.25))
    assert repr(stream) == (
        "<Stream quiver-physical_3bit_3.25ppp: 3 codes of 3 bit, 8 x 10 px, at 2000/s, exposure 500 us, "
        "3.25 photons/pixel>"
    )
    assert "streams: quiver-physical_3bit_3.25ppp>" in repr(clip)
    assert "(relative)" in repr(write_clip(tmp_path / "video", frames=2, relative=True))


def test_the_repr_of_a_data_set_counts_its_clips(tmp_path):
    generation.generate(recipe.parse(fakes.RECIPE), tmp_path / "d", generation.Options(workers=0), make=fakes.make)
    words = "<Dataset small: clips 2 train, 0 val, 1 test; 3 x 8 x 10 frames, rows, columns at 2000.0 fps>"
    assert repr(Dataset.open(tmp_path / "d")) == words


def test_the_repr_of_a_scene_names_camera_and_light():
    scene = Scene("box", 3, Camera(8e-3, 2.8, 1.1e-6, 8, 10), (Constant(1.0),), ())
    assert repr(scene) == (
        "<Scene box, seed 3, speed 1: 0 bodies, light: Constant; camera 8 x 10 px of 1.1 um, 8 mm f/2.8>"
    )


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        (
            QIS(0.8, 1.6, 0.2, 3),
            "QIS (multibit): quantum_efficiency 0.8 e-/photon, dark_current 1.6 e-/s, read_noise 0.2",
        ),
        (BinarySPAD(0.4, 20.0), "BinarySPAD (binary_sum): pde 0.4 avalanches/photon, dark_count_rate 20 1/s, bits 1"),
        (CountingSPAD(0.4, 20.0, 3e-8, 8), "dead_time 3e-08 s, bits 8"),
    ],
)
def test_a_sensor_prints_its_units_and_its_repr_makes_it_again(sensor, words):
    assert words in str(sensor)
    assert eval(repr(sensor)) == sensor


def test_restore_in_one_line(tmp_path):
    """A stream, its clip, their paths and the bare codes give the same video, in the unit of the photons."""
    clip = write_clip(tmp_path / "c", frames=12, height=16, width=20)
    stream, _ = sense(clip, Sensing("quiver-physical", 3, ppp=3.25))
    video = quiver.restore(stream, "moment")
    assert (video.shape, video.dtype) == ((12, 16, 20), np.float32)
    assert video.mean() == pytest.approx(3.25, rel=0.05)
    others = [clip, clip.path, str(stream.path), stream.path.with_suffix(".json")]
    assert all(np.array_equal(quiver.restore(other, "moment"), video) for other in others)
    codes = quiver.restore(stream.codes(), "moment", sensor=stream.sensor, exposure=stream.exposure)
    assert np.array_equal(codes, video)
    assert np.array_equal(quiver.restore(clip, "moment", ppp=3.25), video), "the same seed draws the same codes"


def test_restore_says_what_is_missing(tmp_path):
    clip = write_clip(tmp_path / "c", frames=3)
    with pytest.raises(ValueError, match=r"give one of its streams \(none\) as clip.stream\(NAME\), or ppp="):
        quiver.restore(clip)
    with pytest.raises(ValueError, match="give sensor= and exposure= in seconds"):
        quiver.restore(np.zeros((2, 4, 4), np.uint8))
    with pytest.raises(ValueError, match="are for arrays"):
        quiver.restore(clip, exposure=1.0)
    with pytest.raises(FileNotFoundError, match="no such clip"):
        quiver.restore(tmp_path / "none")
