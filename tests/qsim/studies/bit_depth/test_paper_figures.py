"""Tests the numbers of the paper's two figures on tiny clips with known results."""

import numpy as np
import pytest

from qsim import records
from qsim.clip.clip_info import PHYSICAL, RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.optics.camera import Camera
from qsim.optics.radiometry import photons_per_lux
from qsim.streams.clip import Clip
from qsim.studies.bit_depth import paper_figures

SIZE = (24, 30)


def still_clip(path, frames: int, rate: float, camera: Camera | None = None) -> Clip:
    """Write a clip of an even grey field that never changes."""
    meta = {"shape": [frames, *SIZE], "frame_rate": rate, "exposure": 1 / rate, "radiance_unit": RELATIVE}
    if camera is not None:
        meta |= {"radiance_unit": PHYSICAL, "camera": records.plain(camera)}
    with ClipWriter(path, meta) as writer:
        for t in range(frames):
            writer.add(t, np.ones(SIZE, np.float32))
    return Clip.open(path)


def test_four_cameras_see_the_same_light(tmp_path):
    camera = Camera(4.5e-3, 2.8, 1.1e-6, *SIZE, vignetting=False)
    clip = still_clip(tmp_path / "grey", 201, 12_000.0, camera)
    panels = paper_figures.figure_1(clip)
    assert [panel.numbers.get("fps") for panel in panels] == [None, 60.0, 240.0, 2000.0, 2000.0]
    for panel in panels[1:]:
        per_lux = photons_per_lux(clip.camera, 1 / panel.numbers["fps"])
        assert panel.numbers["photons_per_frame"] == pytest.approx(per_lux, rel=1e-3)
        assert panel.numbers["electrons_per_frame"] == pytest.approx(0.8 * per_lux, rel=1e-3)
        assert panel.numbers["blur_over_peak"] == pytest.approx(0, abs=1e-9)
    slow, _, fast, quanta = panels[1:]
    # Linear, unclipped at 66 e-: variance (electrons + 5.1^2 + rounding) / electrons^2 of the light
    electrons = slow.numbers["electrons_per_frame"]
    expected = 10 * np.log10(electrons**2 / (electrons + 5.1**2 + 1 / 12))
    assert slow.numbers["psnr_db"] == pytest.approx(expected, abs=0.8)  # 720 pixels: 0.23 dB is one sigma
    assert quanta.numbers["psnr_db"] > fast.numbers["psnr_db"] + 6
    assert paper_figures.draw([panels]).startswith(b"\x89PNG")


def test_planes_of_an_even_field_are_averaged_without_blur(tmp_path):
    clip = still_clip(tmp_path / "grey", 63, 10_000.0)
    panels = paper_figures.figure_2(clip, 0.51, bits=(1, 3, 5))[1:]
    for panel in panels:
        planes = 2 ** panel.numbers["bits"] - 1
        assert panel.numbers["detections_per_pixel"] == pytest.approx(
            planes * (1 - np.exp(-0.51)), abs=5 * np.sqrt(planes * 0.24 / 720)
        )
    scores = [panel.numbers["psnr_db"] for panel in panels]
    assert scores[2] > scores[1] + 4  # 31 planes for 7: 6.5 dB


def test_rates_that_do_not_divide_are_refused(tmp_path):
    camera = Camera(4.5e-3, 2.8, 1.1e-6, *SIZE)
    with pytest.raises(ValueError, match="not a whole multiple of 60 fps"):
        paper_figures.figure_1(still_clip(tmp_path / "grey", 3, 10_000.0, camera))
    with pytest.raises(ValueError, match="one frame at 60 fps needs 200"):
        paper_figures.figure_1(still_clip(tmp_path / "short", 3, 12_000.0, camera))
