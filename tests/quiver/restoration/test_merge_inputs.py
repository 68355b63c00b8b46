"""Inputs of MergeNet: noise of one unit for every sensor, and a map that falls where codes tell nothing."""

import numpy as np
import pytest
import torch
from merge_windows import one_frame

from qsim.keys import Key
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines.domain_tables import domain_tables
from quiver.baselines.information_domain import information_domain
from quiver.baselines.path_merge import GROUPS, Merged, stream
from quiver.model.mergenet import INPUTS
from quiver.restoration import merge_inputs as mi
from quiver.restoration.merge_inputs import UNIT

EXPOSURE = 5e-4


def merge_inputs(merged, domain):
    """The inputs of one frame."""
    return one_frame(mi.merge_inputs(merged, domain_tables(domain, torch.device("cpu"))))


def mean_of(codes):
    """A merged frame whose means are that of all codes [T, H, W], without motion."""
    count = np.full(codes.shape[1:], len(codes), np.float32)
    mean = codes.mean(0, dtype=np.float32)
    counts = np.array([len(group) for group in GROUPS], np.float32)[:, None, None] * np.ones_like(mean)
    groups = np.stack([codes[[5 + offset for offset in group]].mean(0, dtype=np.float32) for group in GROUPS])
    tensors = [torch.from_numpy(x)[None] for x in (mean, count, codes[5].astype(np.float32), groups, counts)]
    mean, count, alone, groups, counts = tensors
    return Merged(mean, count, count, alone, mean, count, mean, len(codes), groups, counts)


@pytest.mark.parametrize(
    ("sensor", "photons"),
    [
        (QIS(0.8, 1.6, 0.2, 3), 2.0),
        (QIS(0.8, 1.6, 0.2, 1), 0.6),
        (QIS(0.8, 1.6, 0.2, 7, gain=0.6), 60.0),
        (BinarySPAD(0.5, 25.0, 3), 4.0),
    ],
)
def test_noise_is_one_unit_whatever_the_sensor(sensor, photons):
    codes = sensor.sample(np.full((11, 96, 96), photons), EXPOSURE, key=Key(0, 1), engine="reference")
    inputs = merge_inputs(mean_of(codes), information_domain(sensor, EXPOSURE))
    noise = float(inputs.channels[0].std()) * UNIT
    assert noise == pytest.approx(1, abs=0.15)  # 11 codes: the delta method errs by 0.85 to 1.15
    assert not inputs.channels[2:4].any()
    assert inputs.channels[1].any()
    of_groups = inputs.channels[7 : 7 + len(GROUPS)]
    for channel, group in zip(of_groups, GROUPS, strict=True):  # the merged frame holds the group, too
        assert float(channel.std()) * UNIT == pytest.approx(np.sqrt(1 - len(group) / 11), abs=0.1)


def test_the_map_of_knowledge_falls_where_codes_tell_nothing():
    sensor = QIS(0.8, 1.6, 0.2, 1, gain=0.5 / 26)
    light = np.repeat([6.0, 31.0], 48)[None, :] * np.ones((48, 1))
    codes = sensor.sample(np.broadcast_to(light, (11, 48, 96)), EXPOSURE, key=Key(0, 1), engine="reference")
    known = merge_inputs(mean_of(codes), information_domain(sensor, EXPOSURE)).channels[6]
    assert float(known[:, :32].mean()) < float(known[:, 64:].mean()) - 0.5


def test_the_level_near_saturation_is_that_of_pooled_codes():
    """Of pixels that are nearly all saturated, the mean of phi is too dark; phi of the mean code is not."""
    sensor = BinarySPAD(1.0, 0.0, 1)
    photons = 4.0
    codes = sensor.sample(np.full((11, 96, 96), photons), EXPOSURE, key=Key(0, 1), engine="reference")
    domain = information_domain(sensor, EXPOSURE)
    inputs = merge_inputs(mean_of(codes), domain)
    truth = float(domain.forward(sensor.mean(np.array(photons), EXPOSURE)))
    around = inputs.phi + inputs.channels[4] * UNIT * inputs.deviation
    assert abs(float(around.mean()) - truth) < 0.5 * abs(float(inputs.phi.mean()) - truth)


def test_groups_without_a_frame_tell_nothing():
    codes = np.random.default_rng(3).integers(0, 8, (3, 16, 24)).astype(np.uint8)
    sensor = QIS(0.8, 1.6, 0.2, 3)
    domain = information_domain(sensor, EXPOSURE)
    merged = next(stream(lambda t: codes[t], 3, domain, 11, range(1)))
    there = [False, True, False, True, False, False]
    assert (merged.group_counts.amax((2, 3)) > 0)[0].tolist() == there
    channels = merge_inputs(merged, domain).channels[7 : 7 + len(GROUPS)]
    assert not channels[[0, 2, 4, 5]].any()
    assert channels[1].any()


def test_what_looks_alike_is_told_with_its_noise():
    """Still stripes: over the merged frame, what looks alike differs by the noise of the merged frame alone."""
    sensor = QIS(0.8, 1.6, 0.2, 6)
    light = np.broadcast_to(np.where(np.arange(64) // 2 % 2, 40.0, 16.0), (11, 64, 64))
    codes = sensor.sample(light, EXPOSURE, key=Key(0, 2), engine="reference")
    domain = information_domain(sensor, EXPOSURE)
    inputs = merge_inputs(mean_of(codes), domain)
    of_merged, fewer, of_alone, fewer_than_alone = inputs.channels[7 + len(GROUPS) :]
    truth = domain.forward(sensor.mean(light[0], EXPOSURE))
    for channel, octaves, share in ((of_merged, fewer, 0.25), (of_alone, fewer_than_alone, 0.6)):
        restored = inputs.phi + channel * UNIT * inputs.deviation
        stated = inputs.deviation * 2.0 ** (-UNIT * octaves)
        assert np.median(np.abs(restored - truth)) < share * np.median(np.abs(inputs.phi - truth))
        assert np.median(stated) < share * np.median(inputs.deviation)


@pytest.mark.parametrize("level", ["dark", "saturated"])
@pytest.mark.parametrize("bits", [1, 3, 7])
def test_extreme_codes_give_finite_inputs(level, bits):
    sensor = QIS(0.8, 0.0, 0.2, bits)
    codes = np.full((4, 8, 16), 0 if level == "dark" else sensor.levels - 1, np.uint8)
    domain = information_domain(sensor, EXPOSURE)
    merged = next(stream(lambda t: codes[t], 4, domain, 11, range(1)))
    inputs = merge_inputs(merged, domain)
    assert inputs.channels.shape == (INPUTS, 8, 16)
    assert np.isfinite(inputs.channels).all()
    assert np.isfinite(domain.inverse(inputs.phi)).all()
