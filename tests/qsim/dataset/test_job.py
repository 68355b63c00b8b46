"""Jobs of earlier versions."""

from __future__ import annotations

import pytest
from clips import write_dataset

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
