"""Merging along paths: weights against a plain reference, counts against the noise, ends of time, odd sizes."""

import numpy as np
import pytest
import torch
from merge_windows import one_frame
from scipy.ndimage import gaussian_filter, shift
from stats import assert_mean

from qsim.keys import Key
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import path_merge as pm
from quiver.baselines.domain_tables import domain_tables
from quiver.baselines.information_domain import FLOOR, information_domain
from quiver.baselines.paths.motion_paths import Moves
from quiver.baselines.sliding_window import existing_frames, moved_window

EXPOSURE = 5e-4
SENSOR = QIS(0.8, 1.6, 0.2, 3)


def merged(codes, t, sensor=SENSOR, window=11):
    domain = information_domain(sensor, EXPOSURE)
    return one_frame(next(pm.stream(lambda i: codes[i], len(codes), domain, window, range(t, t + 1))))


def plain_agreement(difference, variance):
    """agreement() in loops over cells of 2 x 2 pixels."""
    cells = difference.reshape(difference.shape[0] // 2, 2, -1, 2).mean((1, 3))

    def box(x, radius):
        grown = np.pad(x, radius, mode="edge")
        side = 2 * radius + 1
        rows, columns = (range(length) for length in x.shape)
        return np.array([[grown[y : y + side, z : z + side].mean() for z in columns] for y in rows])

    coarse = box(box(cells, 1) ** 2 * 36 / variance, 1)
    fine = box(cells**2 * 4 / variance, 2)
    return 1 / (1 + np.maximum(0, np.maximum(coarse - 3, (fine - 1.6) / 0.25)))


def test_fine_detail_that_a_path_misses_costs_weight():
    """Stripes two pixels wide, moved by their width: means of 6 x 6 pixels hardly differ, cells of 2 x 2 do."""
    noise = np.random.default_rng(0).normal(0, 1, (24, 24)).astype(np.float32)
    stripes = np.where(np.arange(24) // 2 % 2, 2.0, -2.0).astype(np.float32)
    variance = torch.ones(1, 1, 12, 12)
    same, missed = (
        pm.agreement(torch.from_numpy(noise + x)[None, None], variance).numpy() for x in (0 * stripes, stripes)
    )
    assert np.median(same) > 0.9
    assert np.median(missed) < 0.1


@pytest.mark.parametrize("seed", range(6))
def test_weights_are_those_of_a_plain_program(seed):
    rng = np.random.default_rng(seed)
    height, width = (2 * int(n) for n in rng.integers(1, 9, 2))
    first = -int(rng.integers(0, 6))
    offsets = list(range(first, int(rng.integers(max(0, first + 1), 6)) + 1))
    domain = information_domain(SENSOR, EXPOSURE)
    moved = rng.integers(0, 8, (len(offsets), height, width)).astype(np.float32)
    inside = (rng.random(moved.shape) < 0.8).astype(np.float32)
    inside[offsets.index(0)] = 1
    groups = pm.groups_of(offsets)
    places = [[i for i, offset in enumerate(offsets) if offset in group] for group in groups]
    counts = np.stack([inside[place].sum(0) for place in places])
    sums = np.stack([(moved * inside)[place].sum(0) for place in places])
    beside = np.stack([moved[place].sum(0) for place in places[: pm.NEAR]])
    given = [torch.from_numpy(x)[None] for x in (moved[offsets.index(0)], sums, counts, beside)]
    weights, means, total_of_near, base = pm.group_weights(*given, domain_tables(domain, torch.device("cpu")))
    found = np.zeros_like(moved)
    found[offsets.index(0)] = 1
    for g, place in enumerate(places):
        found[place] = weights[0, g].numpy() * inside[place]

    def half(x):
        return x.reshape(height // 2, 2, width // 2, 2).mean((1, 3))

    mean = half((moved * inside).sum(0) / inside.sum(0))
    grown = np.pad(mean, 1, mode="edge")
    local = [[grown[y : y + 3, x : x + 3].mean() for x in range(mean.shape[1])] for y in range(mean.shape[0])]
    variance = np.maximum(np.interp(local, domain.mean_code, domain.variance), FLOOR)

    def enlarged(cells):
        image = torch.from_numpy(cells)[None, None]
        return torch.nn.functional.interpolate(image, scale_factor=2, mode="bilinear")[0, 0].numpy()

    expected = np.zeros(moved.shape)
    at = {k: i for i, k in enumerate(offsets)}
    expected[at[0]] = 1
    for k in {-1, 1} & at.keys():
        expected[at[k]] = inside[at[k]] * enlarged(plain_agreement(moved[at[k]] - moved[at[0]], 2 * variance))
    near = [at[k] for k in (-1, 0, 1) if k in at]
    total = expected[near].sum(0)
    base_code = (expected[near] * moved[near]).sum(0) / total
    assert total_of_near[0].numpy() == pytest.approx(total, abs=1e-4)
    assert base[0].numpy() == pytest.approx(base_code, abs=1e-4)
    for side in (-1, 1):
        for pair in ((2, 3), (4, 5)):
            group = [at[side * k] for k in pair if side * k in at]
            if group:
                count = np.maximum(inside[group].sum(0), 1)
                mean = (moved[group] * inside[group]).sum(0) / count
                assert means[0, places.index(sorted(group))].numpy() == pytest.approx(mean, abs=1e-5)
                weight = enlarged(plain_agreement(mean - base_code, (half(1 / count) + half(1 / total)) * variance))
                expected[group] = weight * inside[group]
    assert found == pytest.approx(expected, abs=1e-4)


def still(sensor, photons, frames, side=48, seed=0):
    return sensor.sample(np.full((frames, side, side), photons), EXPOSURE, key=Key(seed, seed), engine="reference")


@pytest.mark.parametrize(("sensor", "photons"), [(SENSOR, 0.5), (SENSOR, 3.25), (BinarySPAD(1.0, 0.0, 1), 0.7)])
def test_flat_light_keeps_its_mean_and_nearly_all_frames(sensor, photons):
    codes = still(sensor, photons, 11, side=64)
    found = merged(codes, 5, sensor)
    variance = float(sensor.variance(np.array(photons), EXPOSURE))
    # pixels of one frame are shared by their neighbours' interpolation: 4 of them count as one at most
    sample = found.mean_code[8:-8, 8:-8][::4, ::4]
    assert_mean(sample, float(sensor.mean(np.array(photons), EXPOSURE)), variance)
    assert found.count.mean() > 9
    assert found.frames == 11


def test_groups_are_means_of_their_frames():
    """Of a still scene: nothing moves, so that plain means are known."""
    codes = still(SENSOR, 2.0, 9)
    found = merged(codes, 3)
    for group, mean, count in zip(pm.GROUPS, found.groups, found.group_counts, strict=True):
        there = [3 + offset for offset in group if 0 <= 3 + offset < 9]
        assert np.median(count) == pytest.approx(len(there), rel=1e-4)
        assert (np.abs(count - len(there)) < 1e-4).mean() > 0.9
        expected = codes[there].mean(0) if there else np.zeros(mean.shape)
        assert (np.abs(mean - expected) < 1e-4).mean() > 0.9  # noise may move a few places


def noise_over_stated(rng, sensor, photons, speed, shake, offsets):
    """Deviation of merged codes of flat light over the stated one [H, W], along motions that are given; 24 draws."""
    height, width = (int(side) for side in rng.integers(40, 90, 2))
    domain = information_domain(sensor, EXPOSURE)
    tables = domain_tables(domain, torch.device("cpu"))
    light = np.full((24, len(offsets), height, width), photons)
    codes = np.stack([sensor.sample(x, EXPOSURE, key=Key(int(rng.integers(1 << 30)), 0)) for x in light])
    window = pm.prepared(torch.from_numpy(codes), tables)
    filled = window.codes.shape[-2:]
    velocity = torch.from_numpy(rng.uniform(-speed, speed, (1, 2, 1, 1)).astype(np.float32))
    bend = torch.from_numpy(rng.uniform(-0.2, 0.2, (1, 2, 1, 1)).astype(np.float32)) * (speed > 0)
    path = tuple(field.expand(24, -1, *filled) for field in (velocity, bend))
    camera = torch.from_numpy(rng.uniform(-shake, shake, (1, len(offsets), 2, 3)).astype(np.float32))
    camera[:, offsets.index(0)] = 0
    found = pm.merge_along(window, offsets, tables, Moves(path, camera.expand(24, -1, -1, -1)))
    mean = float(sensor.mean(np.array(photons), EXPOSURE))
    variance = float(sensor.variance(np.array(photons), EXPOSURE))
    error = (found.mean_code[:, :height, :width] - mean) * (found.count[:, :height, :width] / variance).sqrt()
    return error.square().numpy()


@pytest.mark.parametrize("seed", range(16))
def test_counts_state_the_noise_at_any_speed_and_anywhere(seed):
    """Over sensors, light, sizes, places in time, paths that bend and a shaking camera; along the border, too."""
    rng = np.random.default_rng(seed)
    sensor = [SENSOR, BinarySPAD(1.0, 0.0, 1), QIS(0.8, 1.6, 0.2, 5)][seed % 3]
    photons = [3.25, 0.7, 9.0][seed % 3]
    before = int(rng.integers(0, 6))
    offsets = range(-before, int(rng.integers(1, 6)) + 1)
    speed = float(rng.choice([0.0, 0.4, 3.0, 14.0]))
    shake = float(rng.choice([0.0, 2.0]))
    squares = noise_over_stated(rng, sensor, photons, speed, shake, offsets)
    assert np.sqrt(squares.mean()) == pytest.approx(1, abs=0.03)
    rim = np.ones(squares.shape[1:], bool)
    rim[2:-2, 2:-2] = False
    assert np.sqrt(squares[:, rim].mean()) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("speed", [1.5, 6.0, 14.0])
def test_a_moving_texture_is_merged_sharp(speed):
    """The merged frame has less error than three frames could have, where a mean without motion has far more."""
    rng = np.random.default_rng(2)
    texture = 12 * np.exp(1.2 * gaussian_filter(rng.normal(size=(160, 400)), 2) / 0.14 / 2)
    frames = np.stack(
        [np.clip(texture[32:-32, 150 - round(speed * k) : 246 - round(speed * k)], 0, 60) for k in range(-5, 6)]
    )
    sensor = QIS(0.8, 1.6, 0.2, 5, gain=0.5)
    codes = sensor.sample(frames, EXPOSURE, key=Key(1, 1), engine="reference")
    truth = sensor.mean(frames[5], EXPOSURE)
    found = merged(codes, 5, sensor)
    noise = float(sensor.variance(frames[5], EXPOSURE).mean())
    inner = (slice(16, -16), slice(16, -16))
    assert ((found.mean_code - truth)[inner] ** 2).mean() < noise / 3
    assert ((found.still - truth)[inner] ** 2).mean() > 2 * noise


def test_a_frame_of_another_scene_has_little_weight():
    codes = still(SENSOR, 1.0, 11)
    codes[6:] = still(SENSOR, 5.0, 5, seed=1)
    found = merged(codes, 5)
    assert found.mean_code.mean() == pytest.approx(float(SENSOR.mean(np.array(1.0), EXPOSURE)), rel=0.2)
    assert found.count.mean() < 8


@pytest.mark.parametrize("shape", [(1, 8, 10), (2, 10, 7), (3, 1, 1), (5, 9, 33), (12, 8, 10)])
def test_any_size_and_any_number_of_frames(shape):
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 8, shape).astype(np.uint8)
    restored = pm.restore(codes, SENSOR, EXPOSURE)
    assert restored.shape == shape
    assert restored.dtype == np.float32
    assert np.isfinite(restored).all()
    if shape[0] == 1:
        assert restored[0] == pytest.approx(SENSOR.response(EXPOSURE).invert(codes[0], 1), rel=1e-6)


def test_saturated_pixels_of_the_first_frame_saw_the_frames_of_its_window():
    """One saturated plane had the light of eleven; the window of the first frame is moved into the stream."""
    sensor = BinarySPAD(1.0, 0.0, 1)
    window = 11
    for length, seen in ((1, 1), (6, 6), (20, 11)):
        first = pm.restore(np.ones((length, 16, 16), np.uint8), sensor, EXPOSURE, window=window)[0]
        np.testing.assert_allclose(first, sensor.response(EXPOSURE).cap(seen), rtol=1e-6)


def test_frames_restored_alone_are_those_of_the_stream():
    codes = np.random.default_rng(1).integers(0, 8, (9, 16, 24)).astype(np.uint8)
    everything = pm.restore(codes, SENSOR, EXPOSURE, window=5)
    assert np.array_equal(pm.restore(codes, SENSOR, EXPOSURE, window=5, frames=range(3, 6)), everything[3:6])


def test_a_stream_reads_each_frame_once_and_no_further_than_its_window():
    codes = np.random.default_rng(1).integers(0, 8, (9, 16, 16)).astype(np.uint8)
    read = []
    domain = information_domain(SENSOR, EXPOSURE)
    stream = pm.stream(lambda i: read.append(i) or codes[i], 9, domain, 5, range(9))
    for t, _ in enumerate(stream):
        assert read == list(range(min(max(t + 3, 5), 9)))


def test_threads_change_nothing():
    codes = np.random.default_rng(4).integers(0, 8, (5, 24, 32)).astype(np.uint8)
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(merged(codes, 2))
    finally:
        torch.set_num_threads(before)
    assert found[1].mean_code == pytest.approx(found[0].mean_code, abs=1e-5)
    assert found[1].count == pytest.approx(found[0].count, abs=1e-4)


def test_a_shift_of_the_scene_by_a_pixel_shifts_the_answer():
    rng = np.random.default_rng(7)
    light = 3 * np.exp(gaussian_filter(rng.normal(size=(72, 88)), 2) * 4)
    frames = np.stack([shift(light, (0, 1.5 * k), order=1, mode="nearest") for k in range(-5, 6)])
    codes = SENSOR.sample(np.clip(frames, 0, None), EXPOSURE, key=Key(3, 3), engine="reference")
    one = merged(codes[:, :-8, :-8], 5)
    other = merged(codes[:, 1:-7, 1:-7], 5)
    apart = (one.mean_code[1:, 1:] - other.mean_code[:-1, :-1])[16:-16, 16:-16]
    error = (one.mean_code - SENSOR.mean(np.clip(frames[5], 0, None), EXPOSURE)[:-8, :-8])[16:-16, 16:-16]
    assert np.sqrt((apart**2).mean()) < 0.35 * np.sqrt((error**2).mean())


def test_what_lies_beyond_the_picture_has_no_weight(monkeypatch):
    """A side of 44 px is filled to 48: the four repeated columns counted as pixels of the picture."""
    velocity = torch.zeros(1, 2, 40, 48)
    velocity[:, 1] = 4.0
    still = torch.zeros(1, 11, 2, 3)
    monkeypatch.setattr(pm, "moves", lambda *_: Moves((velocity, torch.zeros_like(velocity)), still))
    codes = np.random.default_rng(0).integers(0, 8, (11, 40, 44)).astype(np.uint8)
    found = merged(codes, 5)
    column = np.arange(44)
    for group, count in zip(pm.GROUPS, found.group_counts, strict=True):
        seen = sum(((column + 4 * offset >= 0) & (column + 4 * offset < 44)).astype(int) for offset in group)
        np.testing.assert_allclose(count[:40, :44], np.broadcast_to(seen, (40, 44)), rtol=1e-4)
    assert np.isfinite(found.mean_code).all()


def test_saturated_pixels_have_the_light_of_the_frames_that_count(monkeypatch):
    """Where a path leads out of the picture, fewer do. They had that of all frames of the window."""
    sensor = BinarySPAD(1.0, 0.0, 1)
    velocity = torch.zeros(1, 2, 16, 48)
    velocity[:, 1] = 4.0
    still = torch.zeros(1, 11, 2, 3)
    monkeypatch.setattr(pm, "moves", lambda *_: Moves((velocity, torch.zeros_like(velocity)), still))
    found = pm.restore(np.ones((11, 16, 48), np.uint8), sensor, EXPOSURE, frames=range(5, 6))[0]
    places = np.arange(48) + 4 * np.arange(-5, 6)[:, None]
    seen = ((places >= 0) & (places < 48)).sum(0)
    expected = [sensor.response(EXPOSURE).cap(count) for count in seen]
    # Ones without noise: a rounding of the sampling costs a frame some of its weight. Eleven frames have 24 % more.
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=0.06)
    assert seen.min() < 7


def test_all_frames_of_a_still_stream_hold_as_many_codes():
    """The first frame had six frames of eleven."""
    rng = np.random.default_rng(4)
    light = gaussian_filter(rng.uniform(0, 12, (64, 72)), 2)
    codes = SENSOR.sample(np.broadcast_to(light, (14, 64, 72)), EXPOSURE, key=Key(4, 0))
    counts = [float(merged(codes, t).count.mean()) for t in range(14)]
    assert min(counts) > 9
    assert max(counts) <= 11.001


def test_far_frames_count_where_a_place_rests(monkeypatch):
    """At the ends of a stream: one acceleration does not lead farther than half of the window."""
    velocity = torch.zeros(1, 2, 32, 48)
    velocity[:, 0, :, 24:] = 1e-6

    def found(pyramid, offsets, *_):
        return Moves((velocity, 0 * velocity), torch.zeros(1, len(offsets), 2, 3))

    monkeypatch.setattr(pm, "moves", found)
    codes = SENSOR.sample(np.full((20, 32, 48), 3.0), EXPOSURE, key=Key(5, 0))
    count = merged(codes, 0).count
    assert count[:, :20].mean() > 9
    assert count[:, 28:].mean() < 6.001


def changed_by(seed, size, steps):
    """A third of the seeds each: 3 bits at 0.5 photons, 1 bit at 1 and at 0.4. Light [T, H, W] of blobs of `size` px
    that move by `steps`, its codes and the sensor.
    """
    rng = np.random.default_rng([seed, 55])
    picture = gaussian_filter(rng.normal(size=(192, 192)), size, mode="wrap")
    picture = np.exp(0.5 * picture / picture.std())
    light = np.stack([np.roll(picture, t * np.array(steps), axis=(0, 1))[:96, :112] for t in range(14)])
    sensor, photons = ((SENSOR, 0.5), (BinarySPAD(1.0, 0.0, 1), 1.0), (BinarySPAD(1.0, 0.0, 1), 0.4))[seed % 3]
    light *= photons / light.mean()
    return light, sensor.sample(light, EXPOSURE, key=Key(seed, 6)), sensor


def same_as_near(codes, sensor):
    """Where the first frame's far frames have the mean of its near ones."""
    tables = domain_tables(information_domain(sensor, EXPOSURE), torch.device("cpu"))
    return pm.unchanged(pm.halved(torch.from_numpy(codes[None, :11]).float()), range(6), tables)[0]


@pytest.mark.parametrize("seed", range(12))
def test_a_window_that_is_moved_is_no_worse_than_one_that_is_cut(seed, monkeypatch):
    """Where motion is not found, too. A first frame of one bit had lost 1.3 dB."""
    size = (1.0, 2.0, 4.0, 8.0)[seed % 4]
    light, codes, sensor = changed_by(seed, size, (seed % 5 - 2, 1 + seed % 3))
    for t in (0, 2, 13):
        errors = []
        for window in (existing_frames, moved_window):
            monkeypatch.setattr(pm, "moved_window", window)
            found = pm.restore(codes, sensor, EXPOSURE, frames=range(t, t + 1))[0]
            errors.append(np.square(found - light[t]).mean())
        assert errors[1] < 1.02 * errors[0]


@pytest.mark.parametrize("seed", range(12))
def test_motion_that_nothing_finds_shows_all_around(seed):
    """Smooth blobs at little light: with their far frames the network was up to 3 dB worse than without."""
    _, codes, sensor = changed_by(seed, (4.0, 8.0)[seed % 2], ((1, 2), (2, -1), (-2, 2))[seed // 4])
    assert same_as_near(codes, sensor).mean() < 0.3


@pytest.mark.parametrize("seed", range(12))
def test_far_frames_of_a_still_stream_have_the_mean_of_near_ones(seed):
    """Over sensors, light and textures, up to the corners."""
    rng = np.random.default_rng([seed, 56])
    sensor = (SENSOR, BinarySPAD(1.0, 0.0, 1), QIS(0.8, 1.6, 0.2, 7))[seed % 3]
    light = 10 ** rng.uniform(-0.5, 1) * np.exp(0.5 * rng.normal(size=(96, 128)))
    codes = sensor.sample(np.broadcast_to(light, (11, 96, 128)), EXPOSURE, key=Key(seed, 7))
    same = same_as_near(codes, sensor)
    assert same.shape == (96, 128)
    assert same.mean() > 0.7


def test_no_far_frame_counts_while_light_changes():
    light = gaussian_filter(np.random.default_rng(8).uniform(0, 12, (64, 72)), 2)
    fading = np.linspace(1, 0.4, 14)[:, None, None] * light
    codes = SENSOR.sample(fading, EXPOSURE, key=Key(8, 0))
    assert merged(codes, 0).count.max() <= 6.001


@pytest.mark.parametrize("seed", range(4))
def test_light_that_fades_is_not_taken_for_motion(seed):
    """Codes of dark frames have more noise after they are evened out: paths between pixels, which have less, fitted
    better than none on more than half of the places.
    """
    rng = np.random.default_rng(seed)
    texture = np.exp(0.5 * gaussian_filter(rng.normal(size=(128, 128)), 1.5) / 0.19)
    fading = np.linspace(1.3, 0.4, 11)[:, None, None] * 3.25 * texture / texture.mean()
    codes = SENSOR.sample(fading, EXPOSURE, key=Key(seed, 3))
    domain = information_domain(SENSOR, EXPOSURE)
    tables = domain_tables(domain, torch.device("cpu"))
    seen: list[Moves] = []
    found = pm.moves

    def noted(*given):
        seen.append(found(*given))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pm, "moves", noted)
        pm.merge(pm.prepared(torch.from_numpy(codes)[None], tables), range(-5, 6), tables)
    assert (seen[0].path[0].abs().sum(1) > 0).float().mean() < 0.05
