"""Cells of a domain: the nearest one is found, and they survive the metadata of a weights file."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from domains import MEASURED, cell, stream, tensors_digest, weights

from qsim.sensor import devices
from quiver.model.unet import UNet
from quiver.model.weights import annotate, load, metadata_of
from quiver.restoration import domain
from quiver.restoration.domain import Domain, OperatingPoint
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import network_restorer
from quiver.restoration.restorers import PRETRAINED

# ---- The cell of a stream


def test_the_nearest_cell_is_the_nearest_in_log_light():
    """Against a search over all cells of the same kind, for random grids and streams."""
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(300):
        lights = np.exp(rng.uniform(-2, 5, rng.integers(1, 7)))
        bits = [int(b) for b in rng.integers(1, 4, len(lights))]
        cells = tuple(cell(float(p), 1.0, bits=b, sensor="quiver-published") for p, b in zip(lights, bits, strict=True))
        ppp = float(np.exp(rng.uniform(-2.5, 5.5)))
        own = int(rng.integers(1, 4))
        place = domain.place_of(devices.load("quiver-published", ppp=ppp, bits=own), 5e-4, ppp)
        same = [c.ppp for c in cells if c.place.bits == own]
        found = Domain(cells, {}).nearest(place)
        if not same or not min(same) / domain.NEAR <= ppp <= max(same) * domain.NEAR:
            assert found is None
            continue
        inside += 1
        assert abs(math.log(found.ppp / ppp)) == pytest.approx(min(abs(math.log(p / ppp)) for p in same))
    assert inside > 30


def test_sensors_of_one_kind_share_their_cells_in_detected_photons():
    """A clocked SPAD of half the efficiency in twice the light gives the same codes."""
    spad = Domain((cell(2.0, 25.0, bits=1, sensor="spad-320x240"),), {})
    other = devices.load("spad512s", bits=1)
    assert spad.nearest(domain.place_of(other, 5e-4, 2.0 / other.efficiency)) is not None
    assert spad.nearest(domain.place_of(other, 5e-4, 2.0)) is None


# ---- The file


def test_a_domain_survives_its_file():
    assert Domain.from_json(MEASURED.to_json()) == MEASURED


def test_a_damaged_domain_is_one_line(tmp_path):
    """Any value replaced by one of another kind, keys gone, text cut: read alike, or a `ValueError` in one line."""
    good = json.loads(MEASURED.to_json())
    rng = np.random.default_rng(2)
    refused = 0
    values = [None, True, "x", -1, 0, 1e400, math.nan, [], {}, [1], 10**400, "1"]
    for _ in range(300):
        found = json.loads(json.dumps(good))
        spot = [found, found["cells"][0], found["cells"][0]["place"]][int(rng.integers(3))]
        name = str(rng.choice(list(spot)))
        if rng.random() < 0.2:
            del spot[name]
        else:
            spot[name] = values[int(rng.integers(len(values)))]
        text = json.dumps(found)
        text = text[: int(rng.integers(len(text)))] if rng.random() < 0.2 else text
        try:
            Domain.from_json(text)
        except ValueError:
            refused += 1
    assert refused > 200
    path = weights(tmp_path)
    annotate(path, {domain.KEY: "{}"})
    with pytest.raises(ValueError, match=r"small\.safetensors: its domain is damaged .*measure it again"):
        network_restorer(path, RestoreOptions(device="cpu"))


def test_notes_leave_the_tensors_alone(tmp_path):
    path = weights(tmp_path, settings={"seed": 5})
    before = tensors_digest(path)
    settings = metadata_of(path)["settings"]
    annotate(path, {domain.KEY: MEASURED.to_json()})
    assert tensors_digest(path) == before
    assert metadata_of(path)["settings"] == settings
    assert domain.read_scope(path, metadata_of(path)).domain == MEASURED
    assert isinstance(load(path), UNet)
    (tmp_path / "other.safetensors").write_bytes(b"12345678")
    with pytest.raises(ValueError, match="not a safetensors file"):
        annotate(tmp_path / "other.safetensors", {})


# ---- What ships


def test_the_shipped_weights_know_their_domain():
    """The cells are measured: where a classical method is better it is named, and elsewhere nothing is."""
    path = PRETRAINED / "mergenet.safetensors"
    scope = domain.read_scope(path, metadata_of(path))
    cells = [one for one in scope.domain.cells if one.sensor == "quiver-physical"]
    lost = replace(scope, domain=replace(scope.domain, cells=tuple(replace(one, network=0.0) for one in cells)))
    for one in cells:
        source = stream(ppp=one.ppp, bits=one.place.bits)
        said = domain.remark("mergenet", scope, source)
        assert said is None if one.wins else f"mergenet is worse than {one.classical} on {one.name}" in said
        assert f"mergenet is worse than {one.classical}" in domain.remark("mergenet", lost, source)
    assert "never measured near" in str(domain.remark("mergenet", scope, stream(bits=4)))


def test_places_of_one_gain_are_alike():
    one = OperatingPoint("QIS", 3, 2.6, 6.5)
    assert one.like(OperatingPoint("QIS", 3, 26.0, 65.0))  # the same in units of the light
    assert one.like(OperatingPoint("QIS", 3, 1.0, 6.0))  # about the same in photons
    assert not one.like(OperatingPoint("QIS", 3, 1.0, 10.0))
    assert not one.like(OperatingPoint("QIS", 2, 2.6, 6.5))
    assert not one.like(OperatingPoint("BinarySPAD", 3, 2.6, 6.5))
