"""What a reader without qsim should find of a published data set of tests."""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing

SENSINGS = (Sensing("quiver-physical", bits=3, ppp=3.25), Sensing("spad-320x240", ppp=0.8))
KINDS = ("webdataset", "parquet", "hdf5", "zarr")


def expected(clip: Clip) -> dict[str, Array]:
    """The published arrays of a clip by field, from its own files."""
    times = range(len(clip))
    found = {
        "radiance": clip[:].astype(np.float16),
        "sharp": np.stack([clip.sharp(t) for t in times]).astype(np.float16),
        "flow": np.stack([clip.flow(t) for t in times]),
        "flow_back": np.stack([clip.flow_back(t) for t in times]),
        "valid": np.stack([clip.valid(t) for t in times]),
    }
    for number, sensing in enumerate(SENSINGS):
        stream = clip.stream(sensing.stream_name)
        found[f"codes_{number}"] = stream[:]
        found[f"truth_{number}"] = stream.truth().astype(np.float32)
    return found


def same(found: dict[str, Array], clip: Clip) -> None:
    """Assert that arrays are those of a clip, bit by bit and of equal types; none is missing, none is more."""
    wanted = expected(clip)
    assert set(found) == set(wanted)
    for name, array in wanted.items():
        assert found[name].dtype == array.dtype, name
        assert found[name].shape == array.shape, name
        assert found[name].tobytes() == array.tobytes(), name
