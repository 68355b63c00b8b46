"""Codes come to torch from the memory in which they were drawn, and equal those of the host."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from compiled_cases import EXPOSURE, KEY, SENSORS, light, loaded_drjit, needs_engine, reference

from qsim import device_lock
from qsim.backend import RenderEngine
from qsim.keys import Key
from qsim.sensor.row import Row
from qsim.sensor.spad import BinarySPAD
from quiver.data.code_table import draw_codes, draws_at_once
from quiver.data.device_codes import codes_of_rows, codes_on_device

SENSOR = SENSORS["3 bits, gain 1"]


@needs_engine
def test_codes_equal_the_reference_from_tensors_and_arrays():
    photons = light(SENSOR, (3, 7, 10))
    expected = torch.from_numpy(reference(SENSOR, photons, origin=(2, 5)))
    tensor = torch.from_numpy(photons)
    turned = torch.from_numpy(np.ascontiguousarray(photons.transpose(0, 2, 1))).transpose(1, 2)  # other strides
    for given in (photons, tensor, turned, tensor.clone().requires_grad_()):
        codes = codes_on_device(SENSOR, given, EXPOSURE, key=KEY, origin=(2, 5))
        assert codes.dtype == torch.uint8
        assert torch.equal(codes.cpu(), expected)


@needs_engine
def test_nothing_is_copied():
    """Two tensors of one draw share its memory, also after Dr.Jit has released it."""
    drawn = SENSOR.sample_on_device(light(SENSOR, (2, 9, 13)), EXPOSURE, key=KEY)
    first = torch.from_dlpack(drawn)
    second = torch.from_dlpack(drawn)
    assert first.data_ptr() == second.data_ptr()
    before = second.clone()
    del drawn
    first += 1
    assert torch.equal(second, before + 1)


def window_rows(count: int) -> list[Row]:
    """Return rows as windows of a loader have them: other clips, light levels and sensors."""
    sensors = [SENSOR, BinarySPAD(0.5, 10.0, 3), SENSORS["low gain"]]
    return [
        Row(
            sensor=sensors[n % 3],
            exposure=EXPOSURE * (1 + n / 8),
            key=Key(seed=1, clip=n, stage=1),
            scale=2.0 + n,
            at_once=draws_at_once(sensors[n % 3]),
        )
        for n in range(count)
    ]


@needs_engine
@pytest.mark.parametrize("kind", [torch.float16, torch.float32, torch.float64])
def test_codes_of_rows_are_those_of_training_windows(kind):
    photons = torch.rand((5, 3, 16, 18), generator=torch.Generator().manual_seed(0)).to(kind)
    turned = photons.transpose(2, 3).contiguous().transpose(2, 3)  # other strides
    later = torch.cat([photons.new_zeros(1), photons.reshape(-1)])[1:].reshape(photons.shape)  # unaligned memory
    rows = window_rows(5)
    expected = [
        draw_codes(r.sensor, own.double().numpy() * r.scale, r.exposure, r.key)
        for own, r in zip(photons, rows, strict=True)
    ]
    for given in (photons, turned, later):
        codes = codes_of_rows(given, rows)
        assert codes.dtype == torch.uint8
        assert torch.equal(codes.cpu(), torch.from_numpy(np.stack(expected)))


@needs_engine
@pytest.mark.parametrize("width", [16, 18, 21])
def test_packed_codes_of_rows_are_those_of_the_same_rows(width):
    photons = torch.rand((3, 2, 7, width), generator=torch.Generator().manual_seed(1))
    rows = [Row(BinarySPAD(0.5, 10.0 + n), EXPOSURE, Key(seed=1, clip=n), scale=1.0 + n) for n in range(3)]
    codes = codes_of_rows(photons, rows).cpu().numpy()
    found = codes_of_rows(photons, rows, packed=True)
    assert np.array_equal(found.cpu().numpy(), np.packbits(codes, axis=-1))


@needs_engine
def test_no_host_waits_for_codes_of_a_gpu(monkeypatch):
    """Nothing is fetched or waited for between light and codes on a device that has its own queue."""
    dr = loaded_drjit()
    photons = torch.rand((2, 3, 16, 16))
    rows = window_rows(2)
    expected = codes_of_rows(photons, rows).clone()
    waits: list[str] = []
    finish = dr.sync_thread
    monkeypatch.setattr(dr, "sync_thread", lambda: waits.append("sync_thread"))
    monkeypatch.setattr(device_lock, "choose", lambda: RenderEngine("cuda_ad_mono", "cuda", None, "a test"))
    codes = codes_of_rows(photons, rows)
    assert waits == []
    finish()
    assert torch.equal(codes, expected)


def test_light_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"light has the shape \[B, T, H, W\], got \[3, 4, 4\]"):
        codes_of_rows(torch.ones(3, 4, 4), window_rows(3))
