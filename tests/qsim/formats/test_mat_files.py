"""Tests .mat files: parts, the choice of an array, and counts only."""

from pathlib import Path

import numpy as np
import pytest
from recordings import everything, random_planes

from qsim.formats import importing
from qsim.formats.mat_files import mat_array
from qsim.formats.recording import Hints


@pytest.mark.parametrize("level", ["5", "7.3"])
def test_the_only_array_of_a_mat_is_taken(tmp_path, level):
    codes = np.random.default_rng(0).integers(0, 9, (4, 5, 7)).astype(np.uint16)
    path = tmp_path / "a.mat"
    if level == "5":
        from scipy.io import savemat

        savemat(path, {"counts": codes.transpose(1, 2, 0), "gate": 3.0})
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["counts"] = codes.transpose(0, 2, 1)
            file["gate"] = np.ones((1, 1))
    assert np.array_equal(mat_array(path), codes)
    assert np.array_equal(mat_array(path, "counts"), codes)
    recording = importing.read(path, Hints(bits=4))
    assert np.array_equal(recording.read(0, 4), codes)
    with pytest.raises(ValueError, match="has no array OUTPUT; it holds"):
        mat_array(path, "OUTPUT")


def test_a_name_of_an_array_is_refused_elsewhere(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4), bool))
    with pytest.raises(ValueError, match="variable= changes nothing for codes; leave it out"):
        importing.read(tmp_path / "a.npy", Hints(variable="x"))


def test_values_that_are_no_counts_are_refused(tmp_path):
    from scipy.io import savemat

    for name, value in (("half", 0.5), ("negative", -1.0), ("nothing", np.nan)):
        savemat(tmp_path / f"{name}.mat", {"x": np.full((3, 4), value)})
        with pytest.raises(ValueError, match="expected whole numbers >= 0"):
            mat_array(tmp_path / f"{name}.mat")


@pytest.mark.parametrize("level", ["5", "7.3"])
def test_mat_parts_of_unequal_length(tmp_path: Path, level: str):
    expected = random_planes(8, 5, 7)
    for k, part in ((1, expected[:5]), (2, expected[5:])):
        path = tmp_path / f"part_{k}.mat"
        if level == "5":
            from scipy.io import savemat

            savemat(path, {"OUTPUT": part.transpose(1, 2, 0)}, do_compression=k == 2)
        else:
            h5py = pytest.importorskip("h5py")
            with h5py.File(path, "w", userblock_size=512) as file:
                file["OUTPUT"] = part.transpose(0, 2, 1)  # MATLAB's columns first, as HDF5 sees it: [T, W, H]
    (tmp_path / "info.json").write_text('{"no_parts": 2}')
    np.testing.assert_array_equal(everything(tmp_path), expected)
    (tmp_path / "part_2.mat").unlink()
    with pytest.raises(FileNotFoundError, match=r"part_2\.mat: missing, though info\.json states 2 parts"):
        importing.read(tmp_path)
