"""A batch of rows is drawn in one launch, each row as the reference draws it, and compiled once for all of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from compiled_cases import EXPOSURE, KEY, OTHERS, SENSORS, loaded_drjit, needs_engine

from qsim.keys import Key
from qsim.sensor.compiled import rows_kernel
from qsim.sensor.compiled.law_table import LawTable
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.packing import pack
from qsim.sensor.qis import QIS
from qsim.sensor.row import Row
from qsim.sensor.rows import draw_rows
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from quiver.data.code_table import draw_codes

SLOW = ("long sums without noise", "longer sums and full well", "paralyzable, six bits")  # tables of seconds
QUICK = [name for name in SENSORS if name not in SLOW]


def drawn(light: np.ndarray, rows: list[Row]) -> np.ndarray:
    """Return the codes [B, T, H, W] of light [B, T, H, W]."""
    frames, height, width = light.shape[1:]
    found = draw_rows(light.reshape(-1), (len(rows), frames, height, width), rows)
    return found.numpy().view(np.uint8).reshape(*light.shape[:3], -1)[..., :width]


def expected(light: np.ndarray, rows: list[Row]) -> np.ndarray:
    """Return the reference's codes of the same rows."""
    codes = []
    for own, row in zip(light, rows, strict=True):
        photons = own.astype(np.float64) * row.scale
        if row.at_once:
            codes.append(draw_codes(row.sensor, photons, row.exposure, row.key, row.origin))
        else:
            codes.append(row.sensor.sample(photons, row.exposure, key=row.key, origin=row.origin, engine="reference"))
    return np.stack(codes)


def some_sensor(rng: np.random.Generator) -> Sensor:
    """Return a sensor of any model with random parameters of their whole range."""
    bits = int(rng.integers(1, 7))
    dark = float(10 ** rng.uniform(-2, 3.5))
    match rng.integers(4):
        case 0:
            return QIS(float(rng.uniform(0.05, 1)), dark, float(rng.uniform(0, 1.5)), bits, float(rng.uniform(0.2, 3)))
        case 1:
            return BinarySPAD(float(rng.uniform(0.05, 1)), dark, bits)
        case 2:
            planes = int(rng.integers(1, 40))
            return BinarySPAD(float(rng.uniform(0.05, 1)), dark).of_planes(planes)
        case _:
            return CountingSPAD(float(rng.uniform(0.05, 1)), dark, float(10 ** rng.uniform(-8, -4)), bits)


def some_row(rng: np.random.Generator, sensor: Sensor) -> Row:
    """Return a row of a sensor with light up to three times its white, at any frame and place."""
    key = Key(*(int(n) for n in rng.integers(0, 1 << 40, 2)), int(rng.integers(1 << 20)), int(rng.integers(4)))
    exposure = EXPOSURE * float(rng.uniform(0.2, 2))
    scale = 3 * sensor.white(exposure) * float(rng.uniform()) ** 2
    origin = (int(rng.integers(2000)), int(rng.integers(2000)))
    return Row(sensor, exposure, key, scale, origin, at_once=bool(rng.integers(2)))


@needs_engine
@pytest.mark.parametrize("seed", range(12))
def test_rows_of_random_sensors_keys_and_places_equal_the_reference(seed):
    """Each row of a batch has another sensor, bits, exposure, key, light and place in the full frame."""
    rng = np.random.default_rng(seed)
    rows = [some_row(rng, some_sensor(rng)) for _ in range(int(rng.integers(1, 5)))]
    shape = (len(rows), *(int(n) for n in rng.integers(1, (4, 20, 60))))
    light = (rng.uniform(size=shape) ** 2).astype([np.float16, np.float32, np.float64][seed % 3])
    np.testing.assert_array_equal(drawn(light, rows), expected(light, rows))


def some_binary(rng: np.random.Generator) -> Sensor:
    """Return a sensor of one bit with random parameters."""
    dark = float(10 ** rng.uniform(-2, 3.5))
    if rng.integers(2):
        return BinarySPAD(float(rng.uniform(0.05, 1)), dark)
    return QIS(float(rng.uniform(0.05, 1)), dark, float(rng.uniform(0, 1.5)), 1, float(rng.uniform(0.2, 3)))


@needs_engine
@pytest.mark.parametrize("seed", range(12))
def test_packed_rows_of_random_sensors_are_the_packed_codes_of_the_reference(seed):
    """Of any width, also of no whole byte, and from any column of the full frame on."""
    rng = np.random.default_rng(seed)
    rows = [some_row(rng, some_binary(rng)) for _ in range(int(rng.integers(1, 5)))]
    shape = (len(rows), *(int(n) for n in rng.integers(1, (4, 20, 60))))
    light = (rng.uniform(size=shape) ** 2).astype([np.float16, np.float32, np.float64][seed % 3])
    found = draw_rows(light.reshape(-1), shape, rows, packed=True).numpy()
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found.reshape(*shape[:3], -1), pack(expected(light, rows), 1))


@needs_engine
@pytest.mark.parametrize("width", [1024, 1021])
def test_undecided_pixels_of_packed_rows_are_decided_on_the_device(width):
    sensor = BinarySPAD(0.5, 25.0)
    light = np.random.default_rng(2).uniform(0, 3, (1, 1, 1024, width)).astype(np.float32)
    found = draw_rows(light.reshape(-1), light.shape, [Row(sensor, EXPOSURE, KEY)], packed=True).numpy()
    wanted = pack(expected(light, [Row(sensor, EXPOSURE, KEY)]), 1)
    np.testing.assert_array_equal(found.reshape(wanted.shape), wanted)


@needs_engine
@pytest.mark.parametrize("name", QUICK)
def test_codes_of_every_law_equal_the_reference(name):
    rng = np.random.default_rng(1)
    sensor = SENSORS[name]
    rows = [Row(sensor, EXPOSURE, KEY.at(t), 2 * sensor.white(EXPOSURE)) for t in (3, 9)]
    light = rng.uniform(size=(2, 2, 16, 48)).astype(np.float32)
    np.testing.assert_array_equal(drawn(light, rows), expected(light, rows))


@needs_engine
def test_undecided_pixels_are_decided_on_the_device():
    """Of a million pixels float32 leaves some open, and two words decide them as the reference does."""
    sensor = SENSORS["3 bits, gain 1"]
    light = np.random.default_rng(2).uniform(0, 9, (1, 1, 1024, 1024)).astype(np.float32)
    rows = [Row(sensor, EXPOSURE, KEY)]
    np.testing.assert_array_equal(drawn(light, rows), expected(light, rows))


@needs_engine
def test_light_beyond_the_table_and_none_at_all():
    sensor = SENSORS["3 bits, gain 1"]
    light = np.array([0, 1e-30, 1e-3, 40, 60, 1e4, 1e12, 3e38], np.float32).reshape(1, 1, 1, 8)
    for scale in (1.0, 0.0):
        rows = [Row(sensor, EXPOSURE, KEY, scale)]
        np.testing.assert_array_equal(drawn(light, rows), expected(light, rows))


@needs_engine
def test_a_batch_is_one_launch_and_nothing_is_compiled_again():
    """Other keys, clips, frames, exposures, light levels, sensors and sizes run the kernel that is there."""
    dr = loaded_drjit()
    rng = np.random.default_rng(3)
    base = Row(SENSORS["3 bits, gain 1"], EXPOSURE, KEY)
    changes: list[tuple[int, dict[str, Any]]] = [
        (1, {}),
        (1, {"key": Key(8, 9, 10, 11)}),
        (1, {"exposure": 3 * EXPOSURE}),
        (1, {"scale": 0.25}),
        (1, {"origin": (40, 8)}),
        (1, {"sensor": SENSORS["low gain"]}),
        (1, {"sensor": SENSORS["dead time"], "exposure": 2 * EXPOSURE}),
        (3, {}),
        (16, {}),
    ]
    launches = []
    recordings = []
    kernel = rows_kernel.kernel(bits=3, light="f", summing=False, shifted=False, whole=True, pixels=rows_kernel.FOUR)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for count, change in changes:
            light = rng.uniform(size=(count, 2, 8, 32)).astype(np.float32)
            dr.kernel_history_clear()
            drawn(light, [replace(base, **change)] * count)
            kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            launches.append([entry["cache_hit"] or entry["cache_disk"] for entry in kernels])
            recordings.append(kernel.n_recordings)
    assert [len(found) for found in launches] == [1] * len(changes)
    assert all(known for found in launches[1:] for known in found)
    assert len(set(recordings)) == 1


@needs_engine
def test_rows_that_do_not_fit_are_refused():
    light = np.ones(2 * 5 * 7, np.float32)
    row = Row(SENSORS["3 bits, gain 1"], EXPOSURE, KEY)
    with pytest.raises(ValueError, match="light has 2 rows, and 1 are described; give one Row for each"):
        draw_rows(light, (2, 1, 5, 7), [row])
    for given in (light.astype(np.int32), light[1:], light.reshape(2, 35)):
        with pytest.raises(ValueError, match=r"light has the shape \[B, T, H, W\] in float16, float32 or float64"):
            draw_rows(given, (2, 1, 5, 7), [row, row])
    with pytest.raises(ValueError, match=r"Row\.scale is finite and not negative, got -1"):
        draw_rows(light, (2, 1, 5, 7), [row, replace(row, scale=-1.0)])
    with pytest.raises(ValueError, match="columns 4294967290 to 4294967296"):
        draw_rows(light, (2, 1, 5, 7), [row, replace(row, origin=(0, (1 << 32) - 6))])
    with pytest.raises(ValueError, match=r"packed= is for codes of 1 bit, and QIS\(.* has 3; leave it out"):
        draw_rows(light, (2, 1, 5, 7), [row, row], packed=True)
    for sensor in OTHERS.values():
        with pytest.raises(ValueError, match="no table holds the law of its codes; use `sample`"):
            draw_rows(light, (2, 1, 5, 7), [row, replace(row, sensor=sensor)])


def test_tables_hold_the_law_of_random_sensors():
    """Cubics are right within the margin less their rounding, and exact polynomials as the law itself is."""
    rng = np.random.default_rng(4)
    for sensor in [*(some_sensor(rng) for _ in range(12)), *(SENSORS[name] for name in QUICK)]:
        exposure = EXPOSURE * float(rng.uniform(0.2, 2))
        table = LawTable.of(sensor, exposure)
        assert table is not None
        x = rng.uniform(0, 1.2 * len(table.exact) / table.rate, 400)
        cell = np.minimum((x * table.rate).astype(int), len(table.exact) - 1)
        share = 2 * (x * table.rate - cell) - 1
        cdf = sensor.cdf_of(x * x, exposure)[:, :-1]
        for polynomials, most in ((table.fast, table.margin - 7e-7), (table.exact, 2e-14)):
            powers = share[:, None] ** np.arange(polynomials.shape[-1])
            found = (polynomials[cell].astype(np.float64) * powers[:, None]).sum(axis=-1)
            assert np.abs(found - cdf).max() <= most
