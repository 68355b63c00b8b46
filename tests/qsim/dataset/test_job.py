"""Digests of jobs: those of earlier versions, and the files that streams read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset

from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.job import Job


def test_a_data_set_of_the_earlier_unit_is_not_mixed_with_the_new_one(tmp_path, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(Job, "digest", property(Job.digest_with))
        folder = write_dataset(tmp_path / "set", {"train": 2})
    (folder / "jobs" / "train_0.json").unlink()
    with pytest.raises(ValueError, match=r"below the 99\.9th percentile; now it is dB below white"):
        write_dataset(folder, {"train": 2})
    assert len(Dataset.open(folder).clips()) >= 1  # it stays readable
    (folder / "dataset.json").unlink()  # killed before its end: only the records show its recipe
    with pytest.raises(ValueError, match="was begun by an earlier version, whose psnr meant"):
        write_dataset(folder, {"train": 2})


FILTERS = '[colour]\nmask = "rggb"\nefficiency.R = 0.4\nefficiency.G = 0.6\nefficiency.B = 0.5\n'
MAPPED = """[sensor]
model = "BinarySPAD"
pde = 0.5
dark_count_rate = 9.0
bits = 1
[defects]
dark_map = "rates.npy"
"""
STREAMS = {
    "filters": '[[streams]]\nsensor = "quiver-physical"\nppp = 3.0\ncolour = "filters.toml"\n',
    "map": '[[streams]]\nsensor = "mapped.toml"\nppp = 3.0\n',
}


def job_in(folder: Path, kind: str, light: float) -> Job:
    """Return the job of a recipe in `folder` beside filters and a map, which state `light`."""
    folder.mkdir(exist_ok=True)
    (folder / "filters.toml").write_text(FILTERS.replace("0.4", str(light)))
    (folder / "mapped.toml").write_text(MAPPED)
    np.save(folder / "rates.npy", np.full((8, 10), light))
    bands = 'bands = "rgb"\n' if kind == "filters" else ""
    head = f'[recipe]\nname = "r"\nframes = 2\nheight = 8\nwidth = 10\n{bands}[[scenes]]\nfamily = "fan"\n'
    (job,) = recipe.parse(head + STREAMS[kind], folder / "recipe.toml").jobs
    return job


@pytest.mark.parametrize("kind", STREAMS)
def test_filters_and_measured_maps_decide_the_digest_and_their_folder_does_not(tmp_path: Path, kind: str):
    """Edited filters or a new map gave the old digest, and moving the filters with their recipe gave another."""
    before = job_in(tmp_path / "a", kind, 0.4).digest
    assert job_in(tmp_path / "b", kind, 0.4).digest == before
    edited = job_in(tmp_path / "a", kind, 0.3)
    assert edited.digest != before
    assert edited.digest == job_in(tmp_path / "b", kind, 0.3).digest
