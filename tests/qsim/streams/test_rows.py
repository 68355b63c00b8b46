"""Rows at their own time: the exact interval of every row, the lean of an edge, truth, redraw, and refusals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from clips import sliding_pattern, write_clip

from qsim.checks import ROW_ORDERS
from qsim.dataset.checking import redraw
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.preparation import prepare
from qsim.streams.rows import Rows
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense

RATE = 2000.0
COUNTER = CountingSPAD(pde=0.5, dark_count_rate=10.0, dead_time=0.0, bits=6)
SENSORS = {
    "QIS": (QIS(0.8, 1.6, 0.2, 3), {}),
    "planes": (BinarySPAD(0.5, 100.0, bits=2), {"group": True, "bits": 2}),
    "slices": (COUNTER, {"slices": 4}),
}


def lines(order: str, height: int, width: int) -> np.ndarray:
    """The number of each pixel's line in the order of reading, [H, W]."""
    y, x = np.mgrid[:height, :width]
    return {"down": y, "up": height - 1 - y, "right": x, "left": width - 1 - x}[order]


def interval(light: np.ndarray, start: np.ndarray, length: float) -> np.ndarray:
    """The light of each pixel from time `start` [H, W] on, by its integral over time (oracle, pixel by pixel)."""
    total = np.concatenate([np.zeros((1, *light.shape[1:])), np.cumsum(light, axis=0)])
    times = np.arange(len(light) + 1)
    found = np.empty(start.shape)
    for y, x in np.ndindex(*start.shape):
        ends = np.interp([start[y, x], start[y, x] + length], times, total[:, y, x])
        found[y, x] = ends[1] - ends[0]
    return found


@pytest.mark.parametrize("order", ROW_ORDERS)
@pytest.mark.parametrize("kind", SENSORS)
def test_every_pixel_sees_its_own_interval_of_the_light(tmp_path, order, kind):
    """Random sizes and delays up to the largest; the photons are those of the integral, in whole and in part."""
    rng = np.random.default_rng([ROW_ORDERS.index(order), len(kind)])
    sensor, how = SENSORS[kind]
    planes = {"QIS": 1, "planes": 3, "slices": 4}[kind]
    for n in range(3):
        height, width = (int(size) for size in rng.integers(1, 12, 2))
        clip = write_clip(tmp_path / f"{n}", frames=14, height=height, width=width, seed=n)
        period = how.get("slices", 1)
        count = (height, width)[order in ("right", "left")]
        delay = period / RATE / count * (1.0 if n == 0 else 1 - 0.999 * rng.random())
        draw = prepare(clip, Sensing(sensor, row_delay=delay, row_order=order, **how))
        light = np.stack([draw.incident(clip, t) for t in range(14)])
        starts = lines(order, height, width) * delay * RATE
        exposures = draw.exposures(clip)
        assert len(exposures) == (14 - int(np.ceil(starts.max() - 1e-9))) // planes
        for t in (0, len(exposures) - 1):
            for exposure, found in zip(exposures[t], draw.light(clip, t, t + 1), strict=True):
                length = len(exposure.frames)
                np.testing.assert_allclose(found, interval(light, exposure.frames.start + starts, length), rtol=1e-9)
                np.testing.assert_allclose(np.unique(exposure.begin * RATE), np.unique(exposure.frames.start + starts))
                np.testing.assert_allclose((exposure.end - exposure.begin) * RATE, length)
        assert draw.frames(clip, 0, 1).shape == (1, height, width)


@pytest.mark.parametrize("order", ROW_ORDERS)
def test_a_moving_edge_leans_by_speed_times_delay(tmp_path, order):
    """An edge that moves 3/8 px per frame: its place in each line is speed x (frame + delay of the line), exactly."""
    speed = 0.375
    height = 16
    width = 24
    along = np.arange(width if order in ("down", "up") else height)
    covered = np.clip(2.0 + speed * np.arange(12)[:, None] - along, 0, 1)  # exact in half precision
    shape = (12, height, width)
    stack = covered[:, None, :] if order in ("down", "up") else covered[:, :, None]
    clip = write_clip(tmp_path / "edge", radiance=np.ascontiguousarray(np.broadcast_to(stack, shape)), relative=True)
    delay = 1 / RATE / 32
    draw = prepare(clip, Sensing(QIS(0.8, 1.6, 0.2, 3), ppp=1.0, row_delay=delay, row_order=order))
    light = draw.light(clip, 5, 6)[0] / draw.level.factor
    found = light.sum(axis=1 if order in ("down", "up") else 0)
    number = lines(order, height, width)[:, 0] if order in ("down", "up") else lines(order, height, width)[0]
    np.testing.assert_allclose(found, 2.0 + speed * (5 + number * delay * RATE), rtol=1e-12)


def test_interpolated_rows_approach_rows_rendered_at_their_instants(tmp_path):
    """Against a clip of 32 times the rate, the error of codes of n clip frames falls as n^-3/2 or faster."""
    height = 9
    width = 40
    fine = 32
    exact = sliding_pattern(4 * fine, height, width, 3, speed=3.0 / fine)
    delay = 1 / RATE / 10
    errors = []
    for n in (1, 2, 4, 8):
        light = exact.reshape(4 * n, fine // n, height, width).mean(axis=1)  # an open shutter at n times the rate
        name = tmp_path / f"{n}"
        clip = write_clip(name, radiance=light, relative=True, frame_rate=n * RATE, exposure=1 / n / RATE)
        how = {"slices": n} if n > 1 else {}
        draw = prepare(clip, Sensing(COUNTER, ppp=1.0, row_delay=delay, **how))
        found = draw.light(clip, 1, 2)[0] / n / draw.level.factor
        starts = fine + np.arange(height)[:, None] * 0.1 * fine + np.zeros(width)
        errors.append(float(np.sqrt(np.mean((found - interval(exact, starts, fine) / fine) ** 2))))
    assert errors[0] < 0.2 * exact.std()
    assert all(more < 0.5 * few for few, more in itertools.pairwise(errors)), errors


@pytest.mark.parametrize("kind", SENSORS)
def test_streams_keep_their_readout(tmp_path, kind):
    """Stored, replayed and drawn again by the description alone; a stream of other rows is not taken for it."""
    sensor, how = SENSORS[kind]
    clip = write_clip(tmp_path / "clip", frames=13, height=7, width=9)
    rows = {"row_delay": 3e-5, "row_order": "up"}
    stream, line = sense(clip, Sensing(sensor, ppp=4.0, name="s", **rows, **how))
    assert "each row 3e-05 s later, up" in line
    assert stream.rows == Rows(3e-5, "up")
    frames = len(stream)
    for t in range(frames):
        drawn, kept = replay(clip, stream, t)
        np.testing.assert_array_equal(drawn, kept)
    (found,) = redraw(stream.path)
    assert (found.differ, found.why) == (0, None)
    assert sense(clip, Sensing(sensor, ppp=4.0, name="s", **rows, **how))[0].info == stream.info
    for other in ({}, {"row_delay": 3e-5}):
        with pytest.raises(FileExistsError, match="exists with other settings"):
            sense(clip, Sensing(sensor, ppp=4.0, name="s", **other, **how))


def test_the_truth_is_that_of_each_row_or_of_the_middle_of_the_frame(tmp_path):
    """Four slices per code: the row read n-th is exposed around frame 4 t + n / 2 + 3 / 2."""
    frames = np.broadcast_to(np.arange(1.0, 21)[:, None, None], (20, 8, 5))
    clip = write_clip(tmp_path / "clip", radiance=np.ascontiguousarray(frames), relative=True)
    how = Sensing(COUNTER, ppp=1.0, slices=4, row_delay=0.5 / RATE, row_order="up")
    stream, _ = sense(clip, how)
    assert stream.shape == (4, 8, 5)
    number = lines("up", 8, 5)
    middle = np.floor(4 + number / 2 + 1.5 + 0.5) + 1  # the radiance of frame t is t + 1
    np.testing.assert_allclose(stream.truth(1, 2)[0] / stream.photons_factor / 4, middle)
    np.testing.assert_allclose(stream.truth(1, 2, at="frame")[0] / stream.photons_factor / 4, 4 + 1.75 + 1.5 + 0.75)
    at_once, _ = sense(clip, Sensing(COUNTER, ppp=1.0, slices=4, name="at_once"))
    np.testing.assert_array_equal(at_once.truth(at="frame"), at_once.truth())
    with pytest.raises(ValueError, match="truth at the time of each row or of the middle of the frame, got 'plane'"):
        stream.truth(at="plane")


def test_readouts_that_cannot_be_are_refused(tmp_path):
    clip = write_clip(tmp_path / "clip", frames=5, height=10, width=7)
    sensor = QIS(0.8, 1.6, 0.2, 3)
    for delay, order, what in ((5.1e-5, "down", "10 rows of 5.1e-05 s"), (7.2e-5, "left", "7 columns of 7.2e-05 s")):
        with pytest.raises(ValueError, match=f"{what} take .* longer than a frame or plane of 0.0005 s; the largest"):
            prepare(clip, Sensing(sensor, row_delay=delay, row_order=order))
    prepare(clip, Sensing(sensor, row_delay=5e-5))
    with pytest.raises(ValueError, match=r"10 rows .* of 0.0005 s"):  # a plane, not the sum of three
        prepare(clip, Sensing(BinarySPAD(0.5, 100.0, bits=2), bits=2, group=True, row_delay=6e-5))
    with pytest.raises(ValueError, match="5 frames are too few for one code, whose last row needs 6"):
        prepare(clip, Sensing(COUNTER, slices=5, row_delay=1e-5))
    half = write_clip(tmp_path / "half", frames=5, height=10, width=7, exposure=2.5e-4)
    with pytest.raises(ValueError, match="rows at their own time need a clip whose shutter is open all the time"):
        prepare(half, Sensing(sensor, row_delay=1e-5))
    for how, message in (
        ({"row_delay": 0.0}, "row_delay: expected a number above 0, got 0.0"),
        ({"row_delay": -1e-6}, "row_delay: expected a number above 0"),
        ({"row_delay": float("nan")}, "row_delay: "),
        (
            {"row_delay": 1e-6, "row_order": "sideways"},
            "row_order: expected one of down, up, right, left, got 'sideways",
        ),
        ({"row_order": "up"}, "row_order up: orders rows that have their own time; give row_delay too"),
    ):
        with pytest.raises(ValueError, match=message):
            Sensing(sensor, **how)


def test_rows_read_no_frame_beyond_their_reach(tmp_path):
    """Delays that are whole but for rounding, as 100 x 0.55 = 55 + 7e-15, and random ones."""
    clip = write_clip(tmp_path / "clip", frames=111, height=101, width=2)
    draw = prepare(clip, Sensing(COUNTER, ppp=1.0, slices=56, row_delay=2.75e-4))
    assert len(draw.exposures(clip)) == 1
    assert draw.frames(clip, 0, 1).shape == (1, 101, 2)
    rng = np.random.default_rng(0)
    for _ in range(300):
        rows = Rows(int(rng.integers(1, 500)) * 1e-6)
        rate = float(rng.choice([500, 2000, 30000, 96800]))
        height = int(rng.integers(1, 300))
        frames = []

        def read(t: int, part: tuple[int, ...], frames: list[int] = frames) -> np.ndarray:
            frames.append(t)
            return np.ones(part[2:])

        light = rows.delayed(read, 0, (0, 0, height, 1), rows.shifts(height, 1, rate))
        np.testing.assert_allclose(light, 1.0, rtol=1e-12)
        assert max(frames) == rows.reach(height, 1, rate)
