"""Quanta Burst Photography: alignment against known motion, merging against averages, and the complete chain."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as moved_by

from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import METHODS, bm3d, moment, patch_alignment, qbp
from quiver.baselines.vst import stabiliser

EXPOSURE = 5e-4
BALL = Path(__file__).parents[2] / "data" / "ball_12bit.npz"
BALL_SPEED = 2.646  # px per frame downwards, measured on the noiseless clip by its centre of gravity


def texture(shape, seed=0, margin=40):
    """A smooth random picture with values 0 ... 1, larger than asked by a margin on all sides."""
    picture = gaussian_filter(np.random.default_rng(seed).random([side + 2 * margin for side in shape]), 2)
    return (picture - picture.min()) / np.ptp(picture)


def view(picture, v, u, margin=40):
    """The inner part of a picture whose content has moved by (v, u)."""
    moved = moved_by(picture, (v, u), order=5, mode="nearest")
    return torch.from_numpy(moved[margin:-margin, margin:-margin].astype(np.float32))


def pyramid_of(image):
    return patch_alignment.pyramid(patch_alignment.pad_image(image))


@pytest.mark.parametrize("motion", [(0.0, 0.0), (2.65, 0.0), (-3.3, 7.7), (12.4, -20.2)])
def test_alignment_finds_a_known_shift_of_a_noiseless_picture(motion):
    """Patches that stay inside the picture: refined within 0.05 px, in whole pixels within 3/4."""
    picture = texture((192, 256))
    shape = (192, 256)
    reference, other = (pyramid_of(view(picture, *m)) for m in ((0, 0), motion))
    corner = patch_alignment.grid(reference[0].shape, patch_alignment.LEVELS[0])[0]
    seen = [(corner[k] > 32) & (corner[k] < shape[k] - 64) for k in (0, 1)]
    for refine, limit in ((True, 0.05), (False, 0.75)):
        error = patch_alignment.align(reference, other, refine_finest=refine) - torch.tensor(motion)[:, None]
        assert error[:, seen[0] & seen[1]].abs().max() < limit


def test_search_is_exhaustive_and_stays_inside():
    """Against a loop over patches and shifts; the candidate of the last patch leads out of the image."""
    rng = np.random.default_rng(2)
    image = torch.from_numpy(rng.random((40, 48)).astype(np.float32))
    corner = torch.tensor([[0, 8, 24, 32], [0, 16, 40, 40]])
    centre = torch.tensor([[0, 3, -2, 9], [0, -2, 1, 9]])
    patches = torch.from_numpy(rng.random((8, 8, 4)).astype(np.float32))
    found, cost = patch_alignment.search(patches, image, corner, centre, 2)
    for n in range(4):
        y, x = corner[:, n].tolist()
        best = None
        start = [
            min(max(int(c), -a - 2), side - 8 - a + 2)
            for c, a, side in zip(centre[:, n], (y, x), (40, 48), strict=True)
        ]
        for v in range(start[0] - 2, start[0] + 3):
            for u in range(start[1] - 2, start[1] + 3):
                if 0 <= y + v <= 32 and 0 <= x + u <= 40:
                    sad = (image[y + v : y + v + 8, x + u : x + u + 8] - patches[..., n]).abs().sum()
                    best = min(best or (torch.inf, 0, 0), (float(sad), v, u))
        assert (float(cost[n]), *found[:, n].tolist()) == (pytest.approx(best[0], rel=1e-5), best[1], best[2])


def test_derivatives_and_bicubic_samples_of_polynomials():
    """The derivative filter is exact to degree 4, cubic convolution to degree 2, away from the border."""
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    quartic = ((x - 10) / 10) ** 4 + ((y - 9) / 10) ** 2
    dy, dx = patch_alignment.derivatives(quartic)
    torch.testing.assert_close(dx[4:-4, 4:-4], (0.4 * ((x - 10) / 10) ** 3)[4:-4, 4:-4], atol=1e-5, rtol=0)
    torch.testing.assert_close(dy[4:-4, 4:-4], (0.02 * (y - 9))[4:-4, 4:-4], atol=1e-5, rtol=0)
    parabola = 0.1 * x**2 - 0.05 * y**2 + 0.3 * x * y
    at = torch.tensor([[3.3, 5.0], [7.25, 4.9]])
    cubic = patch_alignment.sample_cubic(parabola, at, 4)
    linear = patch_alignment.sample_linear(x + 2 * y, at, 4)
    step = torch.arange(4.0)
    yy = at[0] + step[:, None, None]
    xx = at[1] + step[None, :, None]
    torch.testing.assert_close(cubic, 0.1 * xx**2 - 0.05 * yy**2 + 0.3 * xx * yy, atol=1e-4, rtol=0)
    torch.testing.assert_close(linear, xx + 2 * yy, atol=1e-5, rtol=0)


def test_candidates_are_the_parent_and_its_nearer_neighbours():
    """Two coarse rows and three columns; eight fine rows per two parents, and the first row looks onwards."""
    fine = patch_alignment.LEVELS[0]
    coarse = patch_alignment.LEVELS[1]
    parent = torch.arange(6.0).reshape(1, 2, 3).expand(2, -1, -1)
    first, down, across = (c[0].reshape(7, 11) / 2 for c in patch_alignment.candidates(parent, 7, 11, fine, coarse))
    assert first[:, 0].tolist() == [0, 0, 0, 0, 3, 3, 3]
    assert first[0].tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2]
    assert down[:, 0].tolist() == [3, 3, 3, 3, 0, 0, 0]
    assert across[0].tolist() == [1, 1, 1, 1, 0, 0, 2, 2, 1, 1, 1]


def test_overlapping_patches_add_up_to_the_image():
    image = torch.from_numpy(np.random.default_rng(0).random((64, 128)).astype(np.float32))
    corner = patch_alignment.grid(image.shape, patch_alignment.LEVELS[0])[0]
    torch.testing.assert_close(qbp.overlap_add(patch_alignment.gather(image, corner, 16), corner, image.shape), image)


def ball_shifts(ppp, settings):
    """Median shift [D, 2] of patches on the ball's horizontal edges, and on the resting plate, over three windows."""
    film = np.load(BALL)["frames"].astype(float)
    light = film[:, 16:376, 96:256] * (ppp / film.mean())  # ball above row 220, plate in rows 316 ... 352
    sensor = quiver_physical(ppp)
    codes = sensor.sample(light, EXPOSURE, key=Key(3, 4), engine="reference")
    corner = patch_alignment.grid(torch.Size((384, 192)), patch_alignment.LEVELS[0])[0]
    on_ball = []
    on_plate = []
    for middle in (5, 7, 9):
        stack = torch.from_numpy(codes[middle - 5 : middle + 6].astype(np.float32) / 7)
        stack = torch.stack([patch_alignment.pad_image(image) for image in stack])
        shifts = qbp.frame_shifts(stack, range(11), settings)
        slope = np.abs(np.diff(light[middle], axis=0, append=light[middle][-1:])).astype(np.float32)
        slope = patch_alignment.pad_image(torch.from_numpy(slope))
        strength = patch_alignment.gather(slope, corner, 16).sum((0, 1))
        above = corner[0] + 16 < 284
        on_ball.append(shifts[..., above & (strength > strength[above].quantile(0.94))])
        on_plate.append(shifts[..., (corner[0] >= 312) & (corner[0] + 16 <= 354)])
    return [torch.cat(found, -1).median(-1)[0].numpy() for found in (on_ball, on_plate)]


def test_alignment_finds_the_speed_of_a_filmed_ball_at_3_photons():
    """A real high-speed clip through the sensor at 3.25 photons per pixel, 0.25 px over all distances in time.

    Some twenty independent patches see a horizontal edge of the ball, each to about 1 px: their median is good to 0.2
    px where it is matched (3 and 4 frames away), and 14 px of motion lie between the first frame and the middle.
    """
    ball, plate = ball_shifts(3.25, qbp.CALIBRATED)
    away = np.arange(-5, 6)
    error = ball[:, 0] - BALL_SPEED * away
    assert np.sqrt(np.mean(error[away != 0] ** 2)) < 0.25
    assert abs(np.polyfit(away, ball[:, 0], 1)[0] - BALL_SPEED) < 0.08
    assert np.abs(plate).max() < 0.25


def test_matched_means_share_no_frame_with_the_middle_and_are_cut_where_the_clip_ends():
    """Complete windows of 11, 7 and 21 frames in blocks of 7; then the first frames of a clip, and a short clip."""

    def matched(count, window, **settings):
        return [(span.start, span.stop) for span in qbp.matched(count, window, qbp.Settings(**settings))]

    assert matched(11, range(11)) == [(0, 3), (1, 4), (4, 7), (7, 10), (8, 11)]
    assert matched(7, range(7)) == [(i, i + 1) for i in range(7)]
    assert matched(21, range(21), block=7) == [(0, 7), (7, 14), (14, 21)]
    assert matched(6, range(-5, 6)) == [(0, 2), (2, 5), (3, 6), (4, 6)]
    assert matched(7, range(-4, 7)) == [(0, 3), (3, 6), (4, 7), (5, 7)]
    assert matched(4, range(-4, 7)) == [(0, 1), (1, 2), (2, 3), (3, 4)]  # three frames around 1 leave nothing
    assert matched(8, range(-9, 12), block=7) == [(0, 5), (5, 8)]


@pytest.mark.parametrize("windows", [6, pytest.param(24, marks=pytest.mark.slow)])
def test_shifts_near_the_ends_follow_the_motion(windows):
    """Noiseless pictures at constant speed, random windows that reach beyond the clip or not: 0.15 px.

    Frames beyond the ends were reflections, and took the shift of the place that they filled. A single block has
    nothing to be matched with.
    """
    rng = np.random.default_rng(6)
    picture = texture((64, 128))
    for _ in range(windows):
        block = int(rng.choice([1, 1, 3]))
        window = block * int(rng.integers(2, 12))
        length = int(rng.integers(2, 12))
        frame = int(rng.integers(length))
        speed = rng.uniform(-2, 2, 2)
        here = range(max(0, frame - window // 2), min(length, frame + (window - 1) // 2 + 1))
        if len(here) <= block:
            continue
        places = range(frame - window // 2 - here.start, frame - window // 2 - here.start + window)
        stack = torch.stack([view(picture, *(speed * (t - frame))) for t in here])
        shifts = qbp.frame_shifts(stack, places, qbp.Settings(block=block))
        corner = patch_alignment.grid(stack.shape[1:], patch_alignment.LEVELS[0])[0]
        seen = [(corner[k] >= 24) & (corner[k] <= stack.shape[1 + k] - 40) for k in (0, 1)]
        true = torch.tensor(np.outer(np.array(here) - frame, speed), dtype=torch.float32)[..., None]
        error = (shifts - true)[..., seen[0] & seen[1]].abs().median(-1)[0].max()
        assert error < 0.15, (block, window, length, frame, speed, error)


@pytest.mark.parametrize("backwards", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_first_and_last_frames_are_merged_along_their_motion(backwards):
    """Six frames instead of eleven raise the error of noise to 11 / 6; a wrong shift of reflected frames raised it
    to more than twice that of a frame in the middle.
    """
    light = moving(26.0, 11, 2.5, shape=(64, 128))[:: -1 if backwards else 1]
    sensor = quiver_physical(26.0)
    codes = sensor.sample(light, EXPOSURE, key=Key(7, 8), engine="reference")
    restored = qbp.restore(codes, sensor, EXPOSURE)
    errors = np.mean((restored - light) ** 2, axis=(1, 2))
    assert max(errors[0], errors[10]) < 11 / 6 * errors[5]


def moving(photons, frames, speed, shape=(72, 88)):
    """Photons [T, H, W] of a texture moving right at this speed, mean as given."""
    picture = texture(shape, seed=4)
    clip = np.stack([view(picture, 0, speed * (t - frames // 2)).numpy() for t in range(frames)])
    return clip * (photons / clip.mean())


@pytest.mark.parametrize(
    ("settings", "gain"), [(qbp.CALIBRATED, 0.5), (qbp.AS_PUBLISHED, 0.8)], ids=["calibrated", "published"]
)
def test_merging_beats_both_one_frame_and_a_plain_mean_when_things_move(settings, gain):
    light = moving(3.25, 11, 2.0)
    sensor = quiver_physical(3.25)
    codes = sensor.sample(light, EXPOSURE, key=Key(7, 7), engine="reference")
    merged = sensor.response(EXPOSURE).invert(qbp.merge(codes, 5, sensor.response(EXPOSURE), 11, settings), 11)
    errors = [
        np.mean((restored - light[5]) ** 2)
        for restored in (
            merged,
            moment.restore(codes[5:6], sensor, EXPOSURE, window=1)[0],
            moment.restore(codes, sensor, EXPOSURE, window=11)[5],
        )
    ]
    assert errors[0] < gain * min(errors[1:])


def test_little_light_on_many_bits_is_merged_as_on_eight():
    """In units of the top code of 16 bits all shifts were equally good, and all noise was the least one.

    A hot pixel decides nothing far from it.
    """
    sensor = QIS(0.8, 1.6, 0.2, 8)
    codes = sensor.sample(moving(3.25, 11, 2.0), EXPOSURE, key=Key(7, 7), engine="reference")
    table = sensor.response(EXPOSURE)
    expected = qbp.merge(codes, 5, table, 11)
    wide = replace(table, top=65535)
    np.testing.assert_allclose(qbp.merge(codes.astype(np.uint16), 5, wide, 11), expected, rtol=1e-5)
    hot = codes.astype(np.uint16)
    hot[:, 70, 86] = 65535
    np.testing.assert_allclose(qbp.merge(hot, 5, wide, 11)[:32, :32], expected[:32, :32], rtol=1e-5)


def test_a_scene_at_rest_is_nearly_averaged():
    """Noise after merging eleven frames is about that of their mean: Wiener weights add some, overlaps take some."""
    sensor = quiver_physical(3.25)
    light = np.repeat(moving(3.25, 1, 0.0), 11, axis=0)
    codes = sensor.sample(light, EXPOSURE, key=Key(1, 9), engine="reference")
    merged = qbp.merge(codes, 5, sensor.response(EXPOSURE), 11)
    truth = sensor.mean(light[5], EXPOSURE)
    ratio = np.std(merged - truth) / np.std(codes.mean(axis=0) - truth)
    assert 0.7 < ratio < 1.3


@pytest.mark.parametrize("name", ["qbp-bm3d", "transform-denoise"])
def test_one_frame_is_denoised_as_one(name):
    """Reflected, it fills the window: its noise was taken for that of as many independent frames, and was left."""
    sensor = quiver_physical(3.25)
    codes = sensor.sample(np.full((1, 48, 56), 3.25), EXPOSURE, key=Key(8, 2), engine="reference")
    restored = METHODS[name].restore(codes, sensor, EXPOSURE)
    assert restored.std() < 0.4 * moment.restore(codes, sensor, EXPOSURE, window=1).std()
    assert restored.mean() == pytest.approx(3.25, rel=0.05)


def test_a_frame_with_a_complete_window_has_the_noise_of_independent_codes():
    """Bit for bit the result that it had before frames near the ends were told from it."""
    sensor = quiver_physical(3.25)
    codes = sensor.sample(moving(3.25, 11, 1.0), EXPOSURE, key=Key(8, 3), engine="reference")
    transform = stabiliser(sensor, EXPOSURE, (1,) * 11)
    stable = transform.forward(qbp.merge(codes, 5, sensor.response(EXPOSURE), 11))
    expected = transform.inverse(bm3d.denoise(stable, 11**-0.5, peak=transform.peak))
    found = METHODS["qbp-bm3d"].restore(codes, sensor, EXPOSURE, frames=range(5, 6))[0]
    np.testing.assert_array_equal(found, expected)


def test_the_other_frames_are_not_trusted_where_they_differ():
    """A neighbour without noise that is wrong everywhere: the merge stays at the reference."""
    sensor = quiver_physical(3.25)
    codes = np.full((3, 64, 64), 6, np.uint8)
    codes[1] = 1
    merged = qbp.merge(codes, 1, sensor.response(EXPOSURE), 3, qbp.Settings(wiener=0.01))
    np.testing.assert_allclose(merged, 1, atol=0.01)


@pytest.mark.parametrize("block", [1, 7])
def test_one_bit_streams(block):
    """Half a photon per pixel and frame; blocks of frames are aligned, and follow the motion within."""
    frames = 11 * block
    light = moving(0.5, frames, 1.5 / block)
    sensor = BinarySPAD(0.4, 25.0, 1)
    codes = sensor.sample(light, EXPOSURE, key=Key(4, 4), engine="reference")
    table = sensor.response(EXPOSURE)
    settings = qbp.Settings(block=block)
    restored = table.invert(qbp.merge(codes, frames // 2, table, frames, settings), frames)
    plain = moment.restore(codes, sensor, EXPOSURE, window=frames)[frames // 2]
    middle = light[frames // 2]
    assert np.mean((restored - middle) ** 2) < 0.9 * np.mean((plain - middle) ** 2)
    assert abs(restored.mean() / middle.mean() - 1) < 0.03


def test_whole_blocks_and_known_choices_only():
    codes = np.zeros((4, 8, 10), np.uint8)
    sensor = quiver_physical(3.25)
    with pytest.raises(ValueError, match="window is 11 frames, which blocks of 4 do not divide"):
        qbp.restore(codes, sensor, EXPOSURE, settings=qbp.Settings(block=4))
    with pytest.raises(ValueError, match="prefilter 1 or 3"):
        qbp.Settings(prefilter=2)
    with pytest.raises(ValueError, match="wiener_variance is sensor or patch, got 'none'"):
        qbp.Settings(wiener_variance="none")


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 9, 70), (4, 8, 10)])
def test_every_method_takes_any_size_and_length(name, shape):
    sensor = quiver_physical(3.25)
    codes = np.random.default_rng(0).integers(0, 8, shape, dtype=np.uint8)
    restored = METHODS[name].restore(codes, sensor, EXPOSURE, window=3)
    assert restored.shape == shape
    assert restored.dtype == np.float32
    assert np.isfinite(restored).all()
    if name not in ("naive", "moment", "likelihood"):  # they are unbiased, and negative below the dark mean
        assert restored.min() >= 0


@pytest.mark.parametrize("name", METHODS)
def test_only_declared_frames_change_a_restored_frame(name):
    """Look-ahead and past: with a window of 3, frame 2 of 5 reads frames 1 and 3 but not 0 and 4."""
    sensor = quiver_physical(3.25)
    rng = np.random.default_rng(5)
    codes = rng.integers(0, 3, (5, 16, 16), dtype=np.uint8)
    base = METHODS[name].restore(codes, sensor, EXPOSURE, window=3)[2]
    for frames, read in (([0, 4], False), ([1], True), ([3], True)):
        changed = codes.copy()
        changed[frames] = rng.integers(0, 3, (len(frames), 16, 16), dtype=np.uint8)
        same = np.array_equal(METHODS[name].restore(changed, sensor, EXPOSURE, window=3)[2], base)
        assert same != read
