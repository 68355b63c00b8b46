"""An array gives the answer of a plain copy of it, whatever memory it lies in: MATLAB's order, slices, maps, bytes."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from memory_orders import all_of
from numpy import ndarray as Array
from random_codes import EXPOSURE, SENSOR

import quiver
from qsim import colour
from qsim.arrays import plain
from qsim.calibration import measure
from qsim.cli import main as qsim_main
from qsim.clip import exr
from qsim.keys import Key
from qsim.sensor import packing
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import METHODS
from quiver.data.codes import array_codes
from quiver.data.photon_counts import read_counts
from quiver.evaluation import metrics
from quiver.restoration.restorers import method_names

RNG = np.random.default_rng(5)
CODES = RNG.integers(0, 8, (2, 8, 10), dtype=np.uint8)
WIDE = RNG.integers(0, 2**10, (3, 8, 10), dtype=np.uint16)
LIGHT = RNG.uniform(0, 8, (2, 10, 12)).astype(np.float32)
LARGE = RNG.uniform(0, 8, (2, 96, 100)).astype(np.float32)  # enough for the compiled engine
MAP = RNG.uniform(size=(8, 10)) < 0.1
SPAD = BinarySPAD(0.4, 20.0, 3)
KEY = Key(1, 2)


def restored(codes: Array, method: str = "moment", defects: Array | None = None) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these codes are noise, on which nothing was measured
        return quiver.restore(codes, method, sensor=SENSOR, exposure=EXPOSURE, defects=defects)


FUNCTIONS: dict[str, tuple[Callable[[Array], Any], Array]] = {
    **{f"METHODS {name}": (lambda x, m=m: m.restore(x, SENSOR, EXPOSURE), CODES) for name, m in METHODS.items()},
    "restore": (lambda x: restored(x, "mergenet"), CODES),
    "defects=": (lambda x: restored(CODES, defects=x), MAP),
    "digest": (lambda x: array_codes(x, SENSOR, EXPOSURE).digest(), CODES.astype(np.uint16)),
    "sample": (lambda x: SPAD.sample(x, EXPOSURE, key=KEY), LARGE),
    "sample_packed": (lambda x: SENSOR.sample_packed(x, EXPOSURE, key=KEY, engine="reference"), LIGHT),
    "sample_on_device": (lambda x: SENSOR.sample_on_device(x, EXPOSURE, key=KEY).numpy(), LARGE),
    "pmf": (lambda x: SENSOR.pmf(x, EXPOSURE), LIGHT),
    "log_likelihood": (lambda x: SENSOR.log_likelihood(x, 3.0, EXPOSURE), CODES),
    "maximum_likelihood": (lambda x: SENSOR.maximum_likelihood(x, EXPOSURE).photons, RNG.integers(1, 9, (2, 3, 8))),
    "pack": (lambda x: packing.pack(x, 10), WIDE),
    "unpack": (lambda x: packing.unpack(x, 16, 5), CODES),
    "measure": (lambda x: vars(measure([x], bits=3, exposure=1.0, photons=None)), CODES),
    "score": (lambda x: vars(metrics.score(x, LIGHT)), LIGHT + np.float32(0.1)),
    "exr": (lambda x: exr.encode({"Z": x}), LIGHT[0]),
    "tone": (lambda x: colour.tone(x, 1.0), LIGHT),
}


def same(one: Any, two: Any) -> bool:
    if isinstance(one, dict):
        return all(same(one[key], two[key]) for key in one)
    if isinstance(one, np.ndarray):
        return one.dtype == two.dtype and one.shape == two.shape and plain(one).tobytes() == plain(two).tobytes()
    return bool(one == two or (one != one and two != two))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_answers_as_for_a_plain_copy(name: str, tmp_path: Path):
    function, array = FUNCTIONS[name]
    expected = function(array.copy())
    forms = all_of(array, tmp_path)
    if name.startswith("METHODS "):  # all pass one door, and some are slow
        forms = {form: forms[form] for form in ("Fortran", "swapped bytes")}
    for form, given in forms.items():
        assert same(function(given), expected), form


def test_every_method_is_tried():
    """The shipped network is tried by `restore`."""
    assert set(method_names()) - {"mergenet"} == {name.removeprefix("METHODS ") for name in FUNCTIONS if " " in name}


def test_a_still_view_and_a_masked_array(tmp_path: Path):
    still = np.repeat(CODES[:1], 2, axis=0)
    for form, given in all_of(still, tmp_path).items():
        assert same(restored(given, "transform-denoise"), restored(still.copy(), "transform-denoise")), form
    with pytest.raises(ValueError, match="masked values; fill them first"):
        METHODS["moment"].restore(np.ma.masked_equal(CODES, 3), SENSOR, EXPOSURE)


@pytest.mark.parametrize(
    ("layout", "array"),
    [
        (["--layout", "codes", "--bits", "10"], WIDE),
        (["--layout", "light", "--transfer", "linear"], LIGHT),
        (["--layout", "light", "--transfer", "srgb"], CODES),
        (["--layout", "cube", "--width", "75"], CODES),
    ],
    ids=["codes", "linear light", "pictures", "cube"],
)
def test_a_file_in_any_order_is_imported_as_a_plain_one(tmp_path: Path, layout: list[str], array: Array):
    made = []
    swapped = array.astype(array.dtype.newbyteorder())
    for i, form in enumerate((array, np.asfortranarray(array), np.asfortranarray(swapped))):
        folder = tmp_path / str(i)
        folder.mkdir()
        np.save(folder / "in.npy", form)
        command = ["convert", str(folder / "in.npy"), str(folder / "out"), *layout, "--frame-rate", "1000"]
        assert qsim_main([*command, "--quiet"]) == 0
        stored = sorted(path for path in folder.rglob("*") if path.suffix in (".npy", ".exr") and path.name != "in.npy")
        made.append([path.read_bytes() for path in stored])
    assert made[0]
    assert made[1] == made[0]
    assert made[2] == made[0]


def test_counts_in_any_order_are_read_as_plain_ones(tmp_path: Path):
    counts = RNG.integers(1, 9, (4, 3, 5, 6)).astype(np.int64)
    np.save(tmp_path / "plain.npy", counts)
    np.save(tmp_path / "other.npy", np.asfortranarray(counts.astype(">i8")))
    one = read_counts(tmp_path / "plain.npy")
    two = read_counts(tmp_path / "other.npy")
    assert same(one.frames, two.frames)
    assert same(one.shares, two.shares)
    assert two.frames.flags.c_contiguous
