"""A published set trains as the data set that it was made of: from a folder, and over the wire."""

from __future__ import annotations

import pytest
import torch
from clips import write_dataset

import quiver
from qsim.cli.program import main as qsim
from qsim.publishing import Publication, publish
from quiver.cli.program import main
from quiver.model import weights


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "set"
    write_dataset(folder, {"train": 2, "val": 1}, sharp=True)
    assert qsim(["sense", str(folder), "--bits", "3", "--ppp", "3.25", "-q"]) == 0
    return folder


def assert_equal_windows(source, published) -> None:
    wanted = quiver.windows(source, split="train", crop=24)
    found = quiver.windows(published, split="train", crop=24)
    assert repr(found) == repr(wanted)
    for n in (0, 1, 7):
        assert found[n].keys() == wanted[n].keys()
        for name, value in wanted[n].items():
            same = torch.equal(found[n][name], value) if isinstance(value, torch.Tensor) else found[n][name] == value
            assert same, name


@pytest.mark.parametrize("kind", ["webdataset", "parquet", "hdf5", "zarr"])
def test_windows_of_a_published_set_are_those_of_the_data_set(data, tmp_path, kind):
    publish(data, tmp_path / "p", Publication(to=kind, fields=("radiance", "sharp", "codes")))
    assert_equal_windows(data, tmp_path / "p")


@pytest.fixture
def bucket(monkeypatch):
    pytest.importorskip("s3fs")
    pytest.importorskip("moto")
    from s3_server import serving

    with serving(monkeypatch):
        yield "s3://bucket"


def test_windows_of_object_storage_are_those_of_the_data_set(data, bucket):
    publish(data, f"{bucket}/set", Publication(fields=("radiance", "sharp", "codes")))
    assert_equal_windows(data, f"{bucket}/set")


@pytest.mark.slow
def test_weights_trained_from_object_storage_are_those_of_the_data_set(data, bucket, tmp_path):
    publish(data, f"{bucket}/set")
    line = ["-q", "--preset", "unet", "--protocol", "control", "--steps", "2", "--crop", "16", "--batch", "1"]
    for name, source in {"remote": f"{bucket}/set", "local": str(data)}.items():
        assert main(["train", source, "-o", str(tmp_path / name), "--workers", "1", *line]) == 0
    remote = weights.load(tmp_path / "remote" / "best.safetensors").state_dict()
    local = weights.load(tmp_path / "local" / "best.safetensors").state_dict()
    assert all(torch.equal(remote[name], value) for name, value in local.items())


def test_a_set_without_light_cannot_train(data, tmp_path):
    publish(data, tmp_path / "p", Publication(fields=("codes", "truth")))
    with pytest.raises(FileNotFoundError, match="field radiance was not published"):
        _ = quiver.windows(tmp_path / "p", split="train", crop=24)[0]
