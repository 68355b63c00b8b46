"""Light that rises from the first code to the last: law, truth, storage, option and key."""

from __future__ import annotations

import json

import numpy as np
import pytest
from clips import write_clip

from qsim import Clip, Sensing, replay
from qsim.cli.program import main
from qsim.sensor.qis import QIS
from qsim.streams.exposures import Timing

SENSOR = QIS(0.8, 1.6, 0.2, 5)


@pytest.fixture
def clip(tmp_path) -> Clip:
    return write_clip(tmp_path / "clip", radiance=np.full((9, 16, 16), 2.0))


@pytest.mark.parametrize("settings", [{}, {"slices": 3}])
@pytest.mark.parametrize("drift", [0.5, -0.5])
def test_codes_and_truth_follow_the_lamp(clip, settings, drift):
    stream = clip.sense(SENSOR, ppp=4.0, light_drift=drift, name="warm", **settings)
    rise = 1 + drift * np.linspace(0, 1, len(stream))
    np.testing.assert_allclose(stream.truth().mean(axis=(1, 2)), 4.0 * rise)
    expected = SENSOR.mean(4.0 * rise, stream.exposure)
    error = np.sqrt(SENSOR.variance(4.0 * rise, stream.exposure) / 256)
    assert (np.abs(stream.codes[:].mean(axis=(1, 2)) - expected) < 5 * error).all()


def test_summed_planes_have_the_light_of_their_code(clip):
    parts = [plane.parts.item() for t in range(3) for plane in Timing(3, True, drift=0.2).over(clip)[t]]
    np.testing.assert_allclose(parts, np.repeat([1.0, 1.1, 1.2], 3))


def test_a_stream_states_its_drift_and_is_drawn_again_with_it(clip):
    warm = clip.sense(SENSOR, ppp=4.0, light_drift=0.5, name="warm")
    assert warm.info.settings["light_drift"] == 0.5
    drawn, kept = replay(clip, warm, 8)
    np.testing.assert_array_equal(drawn, kept)
    plain = clip.sense(SENSOR, ppp=4.0, name="plain")
    assert "light_drift" not in plain.info.settings
    np.testing.assert_array_equal(plain.codes[0], warm.codes[0])
    with pytest.raises(FileExistsError, match="other settings"):
        clip.sense(SENSOR, ppp=4.0, light_drift=0.25, name="warm")


def test_the_command_has_the_option(clip, capsys):
    assert main(["sense", str(clip.path), "--ppp", "4", "--light-drift", "0.2", "--name", "warm", "--json"]) == 0
    (made,) = json.loads(capsys.readouterr().out)["streams"]
    assert "light changes by +20 % to the last code" in made["light"]
    assert main(["sense", str(clip.path), "--ppp", "4", "--light-drift", "-2"]) == 2
    assert "--light-drift: expected a number from -0.9 to 10" in capsys.readouterr().err


def test_it_is_bounded_in_python_too():
    with pytest.raises(ValueError, match=r"light_drift: expected a number from -0\.9 to 10, got 11"):
        Sensing("quiver-physical", light_drift=11)
