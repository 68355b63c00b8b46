"""Codes come to torch from the memory in which they were drawn, and equal those of the host."""

from __future__ import annotations

import numpy as np
import torch
from compiled_cases import EXPOSURE, KEY, SENSORS, light, needs_engine, reference

from quiver.data.device_codes import codes_on_device

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
