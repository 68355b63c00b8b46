"""Makes random planes and codes and reads files back, for the tests of formats."""

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.formats import importing
from qsim.formats.importing import Import
from qsim.formats.recording import Hints
from qsim.streams.clip import Clip

CAPTURE = Import(frame_rate=1000.0)


def random_planes(*shape: int, seed: int = 0) -> np.ndarray:
    return (np.random.default_rng(seed).random(shape) < 0.3).astype(np.uint8)


def one(shape: tuple[int, ...], *places: tuple[int, ...]) -> np.ndarray:
    found = np.zeros(shape, np.uint8)
    for place in places:
        found[place] = 1
    return found


def everything(path: Path, **hints: Any) -> np.ndarray:
    recording = importing.read(path, Hints(**hints))
    return recording.read(0, recording.shape[0])


SIZES = st.tuples(st.integers(1, 5), st.integers(1, 9), st.integers(1, 70))


def clip_of(path: Path, frames: np.ndarray) -> Clip:
    meta = {
        "shape": list(frames.shape),
        "frame_rate": 2000.0,
        "exposure": 5e-4,
        "radiance_unit": RELATIVE,
        "camera": None,
    }
    with ClipWriter(path, meta) as writer:
        for t, frame in enumerate(frames):
            writer.add(t, frame)
    return Clip.open(path)
