"""Measured cells, streams and small weights to check remarks on the domain of a network with."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from qsim.sensor import devices
from quiver.cli.program import main
from quiver.data.codes import Codes, array_codes
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration import domain
from quiver.restoration.domain import Cell, Domain


def cell(ppp: float, network: float, *, bits: int = 3, sensor: str = "quiver-physical", best: float = 20.0) -> Cell:
    seen = devices.load(sensor, ppp=ppp, bits=bits, exposure=5e-4)
    return Cell(sensor, ppp, domain.place_of(seen, 5e-4, ppp), network, "qbp-bm3d", best)


MEASURED = Domain((cell(1.0, 15.0), cell(3.25, 25.0), cell(26.0, 18.0)), {"clips": ["gears"], "seed": 0})


def stream(sensor: str = "quiver-physical", ppp: float = 3.25, bits: int = 3, told: bool = True) -> Codes:
    """Codes of even light [12, 16, 16] that say, or do not say, how bright it was."""
    seen = devices.load(sensor, ppp=ppp, bits=bits, exposure=5e-4)
    rng = np.random.default_rng(0)
    codes = (
        seen.codes_of(rng.poisson(ppp * seen.efficiency, (12, 16, 16)))
        if hasattr(seen, "codes_of")
        else (rng.binomial(seen.levels - 1, -math.expm1(-ppp * seen.efficiency / (seen.levels - 1)), (12, 16, 16)))
    )
    found = array_codes(codes.astype(np.uint8), seen, 5e-4)
    return replace(found, ppp=ppp, sensor_name=sensor) if told else found


def weights(folder: Path, found: Domain | None = None, settings: dict[str, object] | None = None) -> Path:
    """A small network's file, with a domain and with settings of its training."""
    path = folder / "small.safetensors"
    network = UNet(UNetConfig(2))
    notes = {} if settings is None else {"settings": json.dumps(settings)}
    save(network, network.config, path, notes if found is None else notes | {domain.KEY: found.to_json()})
    return path


def tensors_digest(path: Path) -> str:
    found = hashlib.sha256()
    with safe_open(path, "np") as file:
        for name in sorted(file.keys()):
            value = file.get_tensor(name)
            found.update(f"{name} {value.dtype} {value.shape}".encode())
            found.update(value.tobytes())
    return found.hexdigest()


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out, captured.err
