"""Streams whose codes have different exposures: parts equal the whole, `auto` chooses, other methods refuse."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from qsim.keys import Key
from qsim.sensor.qis import QIS
from quiver.data.codes import Codes, array_codes
from quiver.restoration import restorers
from quiver.restoration.automatic import chosen
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.restorers import restorer

SENSOR = QIS(0.8, 1.6, 0.2, 3)
SHARES = (1.0, 0.25)


def bracketed() -> Codes:
    light = np.random.default_rng(1).uniform(0, 20, (1, 9, 7))
    frames = [
        SENSOR.sample(light * SHARES[t % 2], 5e-4 * SHARES[t % 2], key=Key(seed=1, clip=1, frame=t))[0]
        for t in range(13)
    ]
    return replace(array_codes(np.stack(frames), SENSOR, 5e-4), shares=SHARES)


@pytest.mark.parametrize("name", ["naive", "moment:4", "likelihood"])
def test_parts_of_a_stream_equal_the_whole(name):
    codes = bracketed()
    whole = restorer(name).restore(codes)
    parts = [restorer(name).restore(codes, first, last) for first, last in ((0, 3), (3, 10), (10, 13))]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    small = restorer(name, RestoreOptions(memory=30_000))  # blocks of few frames
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that the memory is small
        np.testing.assert_array_equal(small.restore(codes), whole)


@pytest.mark.parametrize("name", ["qbp", "path-merge", "mergenet"])
def test_methods_without_exposures_refuse_the_stream(name):
    with pytest.raises(ValueError, match=f"method '{name}': takes equal exposures only; use naive, moment, likelihood"):
        restorer(name).restore(bracketed())


def test_auto_takes_the_likelihood():
    method, line = chosen("auto", bracketed())
    assert method.name == "likelihood"
    assert line == "auto: likelihood; the codes have different exposures"


def test_on_a_gpu_a_cpu_restores_them_and_that_is_said(monkeypatch):
    monkeypatch.setattr(restorers, "pick_device", lambda wanted: "cuda")
    monkeypatch.setattr(restorers, "device_of_process", lambda kind: torch.device("cpu"))
    monkeypatch.setattr(restorers, "is_gpu", lambda device: True)
    with pytest.raises(ValueError, match=r"device=cuda: moment restores .* on a CPU; give device=cpu"):
        restorer("moment", RestoreOptions(device="cuda", memory=10**9)).restore(bracketed())
    with pytest.warns(UserWarning, match="on a CPU, though this machine has a GPU"):
        found = restorer("moment", RestoreOptions(memory=10**9)).restore(bracketed())
    monkeypatch.undo()
    np.testing.assert_array_equal(found, restorer("moment").restore(bracketed()))
