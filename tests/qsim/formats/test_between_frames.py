"""Frames between frames: true light of moving textures, occlusion, times, saturation, exact frames, what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from clips import sliding_pattern
from numpy import ndarray as Array
from scipy.ndimage import gaussian_filter, shift

import qsim
from qsim.cli.program import main
from qsim.clip.source import Source
from qsim.colour import from_linear, to_linear
from qsim.formats import importing
from qsim.formats.between_frames import Between, at_rate
from qsim.formats.recording import Hints, Recording
from qsim.formats.video import write_video
from qsim.frame_times import Times

pytest.importorskip("cv2")


def texture(seed: int, side: int = 140) -> Array:
    """Return smooth noise of 0 ... 1."""
    noise = gaussian_filter(np.random.default_rng(seed).random((side, side)), 2.5)
    return (noise - noise.min()) / np.ptp(noise)


def squares(t: float) -> Array:
    """Return a bright textured square that goes 8 px per frame to the right before a texture that goes 3 px left."""
    ground = shift(texture(0), (0, -3 * t), order=3)[20:116, 20:116]
    front = 0.5 + 0.5 * shift(texture(1), (0, 8 * t), order=3)[20:116, 20:116]
    x = np.arange(96) + 0.5
    across = np.clip(20.5 - np.abs(x - 38 - 8 * t), 0, 1)
    down = np.clip(20.5 - np.abs(x - 48), 0, 1)
    part = across[None, :] * down[:, None]
    return ground * (1 - part) + front * part


def rms(found: Array, truth: Array) -> float:
    return float(np.sqrt(np.mean((found - truth)[4:-4, 4:-4] ** 2)))


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_moving_textures_are_nearer_than_by_blending_and_repeating(share: float):
    first, second, truth = (squares(t) for t in (0.0, 1.0, share))
    found, mask = Between(first, second).at(share)
    nearest = first if share < 0.5 else second
    blended = rms((1 - share) * first + share * second, truth)
    assert rms(found, truth) < 0.7 * blended < 0.7 * rms(nearest, truth)
    assert not mask.any()


def test_hidden_points_have_the_light_of_the_frame_that_sees_them():
    """Without motion, where both ends differ: one frame where only its flow does not return, else both by the share."""
    first = np.full((24, 24), 0.2)
    second = np.full((24, 24), 0.9)
    between = Between(first, second)
    between._forward = between._back = np.zeros((24, 24, 2), np.float32)
    returns = np.ones((2, 24, 24), np.float32)
    returns[0, :, :8] = 0
    returns[1, :, 16:] = 0
    between._seen = list(returns)
    found, _ = between.at(0.25)
    np.testing.assert_allclose(found[:, :8], 0.2, rtol=1e-6)
    np.testing.assert_allclose(found[:, 8:16], 0.2 + 0.25 * 0.7, rtol=1e-6)
    np.testing.assert_allclose(found[:, 16:], 0.9, rtol=1e-6)


def test_still_light_stays_and_flicker_is_linear():
    """No motion: the mean of both frames by the share, also where a lamp changes all light by a third."""
    light = texture(2, 60)
    for share in (0.2, 0.7):
        found, _ = Between(light, light).at(share)
        np.testing.assert_allclose(found, light, atol=1e-6)
        found, _ = Between(np.full((20, 30), 0.3), np.full((20, 30), 0.4)).at(share)
        np.testing.assert_allclose(found, 0.3 + 0.1 * share, rtol=1e-6)
    black, _ = Between(np.zeros((20, 30)), np.zeros((20, 30))).at(0.5)
    assert (black == 0).all()


def test_time_runs_both_ways():
    """Frames in reverse give the same light, as all weights are symmetric."""
    first = squares(0.0)
    second = squares(1.0)
    there, _ = Between(first, second).at(0.3)
    back, _ = Between(second, first).at(0.7)
    assert rms(there, back) < 0.02 * rms(first, second)


def recording(light: Array, times: tuple[float, ...] | None, mask: Array | None = None) -> Recording:
    """Return light [T, H, W] as a video of float32 whose file states times [s]."""
    masks = np.zeros(light.shape, bool) if mask is None else mask
    stated = None if times is None else Times(times, "s", "its times")
    found = light.astype(np.float32)
    return Recording(
        light.shape,
        lambda a, b: found[a:b],
        Source(format="video", transfer="linear"),
        marked=lambda a, b: (found[a:b], masks[a:b]),
        white=255.0,
        times=stated,
    )


def test_frames_are_at_their_stated_times(tmp_path):
    """Light that grows linearly in time is found at every even time from frames at uneven ones; frames are exact."""
    times = (5.0, 5.1, 5.15, 5.4)
    light = np.stack([np.full((13, 17), 1 + t - 5) for t in times])
    made = at_rate(tmp_path, recording(light, times), 100.0)
    assert made.shape == (41, 13, 17)
    np.testing.assert_allclose(made.read(0, 41)[:, 3, 5], 1 + np.arange(41) / 100, rtol=1e-6)
    assert (made.read(10, 11) == np.float32(light[1])).all()
    assert made.times is None
    assert made.source.taken_rate == pytest.approx(3 / 0.4)
    assert "4 frames in 0.4 s by its times; 41 at 100/s" in made.reading
    assert np.array_equal(made.read(7, 9), made.read(0, 41)[7:9])


def test_saturation_moves_with_the_light(tmp_path):
    light = np.stack([squares(t) for t in (0.0, 1.0)])
    mask = light > 0.8
    made = at_rate(tmp_path, recording(light, (0.0, 0.5), mask), 4.0)
    found = made.marked(0, 3)[1]
    assert np.array_equal(found[0], mask[0])
    assert np.array_equal(found[2], mask[1])
    truth = squares(0.5) > 0.8
    assert (found[1] & truth).sum() > 0.9 * truth.sum()
    assert found[1].sum() < 1.8 * truth.sum()


@pytest.mark.parametrize(
    ("shape", "times", "rate", "message"),
    [
        ((1, 20, 20), (0.0,), 100.0, "estimates light between two frames"),
        ((3, 20, 20), (0.0, 0.1, 0.2), 9.0, "9 is below the 10 frames per second"),
        ((3, 20, 20), None, 100.0, "states no times of its frames in seconds"),
        ((3, 20, 20), (0.0, 0.2, 0.1), 100.0, "the times of its frames do not rise"),
        ((3, 8, 11), (0.0, 0.1, 0.2), 100.0, "8 x 11 pixels; flow is found in frames with a side of 12"),
    ],
)
def test_what_has_no_frames_between_is_refused(tmp_path, shape, times, rate, message):
    with pytest.raises(ValueError, match=message):
        at_rate(tmp_path, recording(np.ones(shape), times), rate)
    codes = Recording((3, 20, 20), lambda a, b: np.zeros((b - a, 20, 20), np.uint8), Source(format="x"), bits=1)
    with pytest.raises(ValueError, match="holds codes"):
        at_rate(tmp_path, codes, 100.0, 10.0)


@pytest.fixture(scope="module")
def phone(tmp_path_factory):
    """A video of 5 frames at 30 per second, sRGB."""
    pytest.importorskip("av")
    light = sliding_pattern(5, 33, 46, 3)
    path = tmp_path_factory.mktemp("phone") / "phone.mp4"
    write_video(path, iter(from_linear((light / light.max()).astype(np.float32), "srgb", 255)), 30.0, lossless=True)
    return path


def test_a_video_becomes_a_clip_at_a_rate(phone, tmp_path, capsys, monkeypatch):
    """The command and the function give one clip; every 2nd frame is the video's own light; it senses."""
    monkeypatch.chdir(tmp_path)
    assert main(["convert", str(phone), "out", "--rate", "60", "--black", "20"]) == 0
    told = capsys.readouterr().err
    assert "5 frames in 0.1333 s by presentation times of the video; 9 at 60/s" in told
    assert "light by srgb, black 20, white 255; not modelled: rolling shutter" in told
    clip = qsim.Clip.open("out")
    made = qsim.from_video(phone, rate=60, black=20)
    assert clip.shape == made.shape == (9, 33, 46)
    assert np.array_equal(clip[:], made[:])
    assert clip.exposure == pytest.approx(1 / 60)
    assert clip.info.source.taken_rate == pytest.approx(30)
    own = importing.read(phone, Hints(transfer="srgb")).read(0, 5)
    dark = to_linear(np.array(20), "srgb", 255)
    np.testing.assert_allclose(clip[::2], np.maximum(own - dark, 0) / (1 - dark), rtol=2e-3, atol=1e-5)
    assert not clip.has_truth
    assert main(["sense", "out", "--ppp", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["streams"][0]["shape"] == [9, 33, 46]


def test_a_given_rate_replaces_the_times_of_the_file(phone):
    """Slow motion: 240 frames per second that play at 30."""
    clip = qsim.from_video(phone, rate=480, frame_rate=240)
    assert len(clip) == 9


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rate", "20"], "--rate: 20 is below the 30 frames per second"),
        (["--rate", "300", "--keep-gaps"], "--keep-gaps changes nothing for video"),
        (["--rate", "300", "--bits", "3"], "--bits changes nothing for video"),
        (["--rate", "0.5"], "--rate: expected"),
    ],
)
def test_what_changes_nothing_is_refused(phone, tmp_path, capsys, words, message):
    assert main(["convert", str(phone), str(tmp_path / "out"), *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
