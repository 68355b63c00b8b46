"""Light that changes for all of a picture: found where it changes, 1 where things move, and evened out in merging."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from qsim.keys import Key
from qsim.sensor.qis import QIS
from quiver.baselines import path_merge as pm
from quiver.baselines.domain_tables import domain_tables
from quiver.baselines.information_domain import information_domain

EXPOSURE = 5e-4
SENSOR = QIS(0.8, 1.6, 0.2, 7)
CPU = torch.device("cpu")
OFFSETS = range(-5, 6)


def picture(rng, side):
    """Light of mean 1 with the spectrum of a natural scene."""
    texture = sum(2**n * gaussian_filter(rng.normal(size=(side, side)), 2.0**n, mode="wrap") for n in range(5))
    return np.exp(0.5 * texture / texture.std())


def window(rng, light, sensor=SENSOR):
    codes = sensor.sample(light, EXPOSURE, key=Key(int(rng.integers(1 << 30)), 0), engine="reference")
    tables = domain_tables(information_domain(sensor, EXPOSURE), CPU)
    return pm.prepared(torch.from_numpy(codes)[None], tables), tables


@pytest.mark.parametrize("seed", range(30))
def test_things_that_move_are_no_light(seed):
    """A camera that pans, rolls round and shakes over 3 to 30 photons, in constant light."""
    rng = np.random.default_rng(seed)
    scene = picture(rng, 128) * 10 ** rng.uniform(0.5, 1.5)
    speed = rng.uniform(-8, 8, 2) * rng.choice([0.0, 0.2, 1.0])
    shifts = [np.round(speed * t + rng.normal(0, rng.choice([0, 2]), 2)).astype(int) for t in OFFSETS]
    found, tables = window(rng, np.stack([np.roll(scene, tuple(s), (0, 1)) for s in shifts])[:, :96, :112])
    assert pm.evened(found, OFFSETS, tables) is found


@pytest.mark.parametrize(
    ("last", "speed", "apart"),
    [(0.3, 0, 0.01), (0.6, 0, 0.01), (1.5, 0, 0.01), (3.0, 0, 0.01), (0.3, 2, 0.025), (3.0, 2, 0.025)],
)
def test_light_that_changes_is_evened_out(last, speed, apart):
    """The merged frame keeps the light of the reference, and holds more than half of the codes that others tell.

    Of things that move the median over 48 squares errs by a few per cent.
    """
    rng = np.random.default_rng(1)
    scene = 8 * picture(rng, 128)
    light = np.stack([np.roll(scene, speed * t, 1) for t in OFFSETS])[:, :96, :112]
    gains = np.geomspace(1 / last, last, 11) if last > 1 else np.linspace(1, last, 11)
    gains = gains / gains[5]
    found, tables = window(rng, light * gains[:, None, None])
    even = pm.evened(found, OFFSETS, tables)
    assert even is not found
    assert even.shares is not None
    assert even.shares[0, 5] == 1
    merged = pm.merge(found, OFFSETS, tables)
    truth = SENSOR.mean(light[5], EXPOSURE)
    inner = (slice(8, -8),) * 2
    assert merged.mean_code[0][inner].mean() == pytest.approx(truth[inner].mean(), rel=apart)
    assert merged.count.mean() > 0.5 * float(even.shares.sum())


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_counts_state_the_noise_of_scaled_codes(gain):
    rng = np.random.default_rng(2)
    gains = np.where(np.arange(11) == 5, 1.0, gain)
    squares = []
    for _ in range(12):
        light = np.full((11, 64, 64), 10.0) * gains[:, None, None]
        found, tables = window(rng, light)
        merged = pm.merge(found, OFFSETS, tables)
        variance = float(SENSOR.variance(np.array(10.0), EXPOSURE))
        error = merged.mean_code - merged.mean_code.mean()  # a common factor is not noise of pixels
        squares.append((error.square() * merged.count / variance).mean().item())
    assert np.sqrt(np.mean(squares)) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("fault", ["black", "white", "scene"])
def test_a_faulty_frame_and_another_scene_stay_without_weight(fault):
    rng = np.random.default_rng(3)
    light = np.broadcast_to(8 * picture(rng, 96), (11, 96, 96)).copy()
    light[6] = {"black": 0.0, "white": 1e4, "scene": 3 * picture(rng, 96)}[fault]
    found, tables = window(rng, light)
    merged = pm.merge(found, OFFSETS, tables)
    assert merged.mean_code.mean() == pytest.approx(SENSOR.mean(light[5], EXPOSURE).mean(), rel=0.02)
    assert (merged.groups[:, 1] * merged.group_counts[:, 1]).isfinite().all()


def test_few_squares_tell_nothing():
    rng = np.random.default_rng(4)
    found, tables = window(rng, np.full((11, 32, 40), 5.0) * np.linspace(0.5, 1.5, 11)[:, None, None])
    assert pm.evened(found, OFFSETS, tables) is found
