"""Tests the axes of arrays, HDF5 datasets and TIFF files: every order of axes gives the same frames, or a refusal."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from recordings import everything

from qsim.formats import importing
from qsim.formats.recording import Hints

SIZES = {"T": 3, "Z": 2, "C": 4, "Y": 5, "X": 6}


def random_frames(axes: str) -> np.ndarray:
    return np.random.default_rng(len(axes)).integers(0, 1 << 12, [SIZES[letter] for letter in axes]).astype(np.uint16)


@pytest.mark.parametrize("kind", ["npy", "h5"])
def test_every_order_of_axes_gives_the_same_frames(tmp_path: Path, kind: str):
    h5py = pytest.importorskip("h5py")
    whole = random_frames("TZCYX")
    for n, order in enumerate(itertools.permutations("TZCYX")):
        if n % 7:  # 18 of 120 orders
            continue
        stored = whole.transpose(["TZCYX".index(letter) for letter in order])
        path = tmp_path / f"{n}.{kind}"
        if kind == "npy":
            np.save(path, stored)
        else:
            with h5py.File(path, "w") as file:
                file["entry/data"] = stored
        found = everything(path, axes="".join(order), channel=2, slice=1, bits=12)
        np.testing.assert_array_equal(found, whole[:, 1, 2])
        light = importing.read(path, Hints(axes="".join(order), channel=2, slice=1, transfer="linear"))
        np.testing.assert_allclose(light.read(1, 3), whole[1:, 1, 2] / 65535, rtol=1e-6)
        assert light.reading == f"read as T=3, Y=5, X=6 of axes {''.join(order)}; channel 2 of 4; slice 1 of 2"


@pytest.mark.parametrize("kind", ["imagej", "ome"])
@pytest.mark.parametrize("axes", ["TCYX", "TZCYX", "TZYX", "CYX", "ZCYX"])
def test_channels_and_slices_of_a_tiff_are_no_frames(tmp_path: Path, axes: str, kind: str):
    """[4, 2, 16, 20] of axes TCYX gave 8 frames."""
    import tifffile

    path = tmp_path / "a.tif"
    stored = random_frames(axes)
    tifffile.imwrite(path, stored, photometric="minisblack", metadata={"axes": axes}, **{kind: True})
    with pytest.raises(
        ValueError, match=f"frames have one axis beside rows and columns; .*{'channel' if 'C' in axes else 'slice'}=0"
    ):
        importing.read(path, Hints(transfer="linear"))
    picks = {"channel": 3 if "C" in axes else None, "slice": 1 if "Z" in axes and "T" in axes else None}
    expected = stored
    for letter, index in (("C", picks["channel"]), ("Z", picks["slice"])):
        if index is not None:
            expected = expected.take(index, axis=expected.ndim - (axes[::-1].index(letter) + 1) + 0)
            axes = axes.replace(letter, "")
    expected = expected if expected.ndim == 3 else expected[None]
    np.testing.assert_array_equal(everything(path, bits=12, **picks), expected)


def test_axes_without_names_are_named_by_the_user(tmp_path: Path):
    import tifffile

    stored = random_frames("TCYX")
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="minisblack")
    with pytest.raises(
        ValueError, match=r"axes Q=3, R=4, Y=5, X=6: frames have one axis .*; name the axis of the frames"
    ):
        importing.read(tmp_path / "a.tif", Hints(bits=12))
    np.testing.assert_array_equal(everything(tmp_path / "a.tif", axes="TCYX", channel=1, bits=12), stored[:, 1])


def test_axes_that_do_not_fit_are_refused(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4, 5), np.float32))
    for hints, message in (
        (Hints(), r"found an array of shape \[2, 3, 4, 5\]; name its axes, as in axes=TCYX"),
        (Hints(axes="TYX"), r"names 3 axes, and the array has \[2, 3, 4, 5\]"),
        (Hints(axes="TTYX"), "a different letter for each axis"),
        (Hints(axes="TCZX"), "axes TCZX lack Y"),
        (Hints(axes="TCYX"), "choose with channel=0"),
        (Hints(axes="TCYX", channel=3), "axis C has 3, from 0"),
        (Hints(axes="TAYX"), "frames have one axis beside rows and columns"),
        (Hints(axes="TSYX"), None),
    ):
        if message is None:
            assert importing.read(tmp_path / "a.npy", hints).shape == (2, 4, 5)
            continue
        with pytest.raises(ValueError, match=message):
            importing.read(tmp_path / "a.npy", hints)
    np.save(tmp_path / "b.npy", np.zeros((2, 3, 4), np.float32))
    with pytest.raises(ValueError, match="channel= changes nothing"):
        importing.read(tmp_path / "b.npy", Hints(channel=0))


def test_hdf5_reads_only_what_lies_in_the_file(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    frames = random_frames("TYX")
    path = tmp_path / "a.h5"
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["secret"] = frames
    with h5py.File(path, "w") as file:
        file["run/one"] = frames
        file["run/two"] = frames
        file["dark"] = frames[0]
        file["outside"] = h5py.ExternalLink(str(other), "/secret")
        file["soft"] = h5py.SoftLink("/run/one")
        layout = h5py.VirtualLayout(frames.shape, frames.dtype)
        layout[:] = h5py.VirtualSource(str(other), "secret", frames.shape)
        file.create_virtual_dataset("virtual", layout)
    np.testing.assert_array_equal(everything(path, dataset="/run/two", bits=12), frames)
    for name, message in (
        (None, r"holds dark \[5, 6\], run/one \[3, 5, 6\].*choose with dataset=, as in dataset=run/one"),
        ("run", "run is a group; it holds one"),
        ("run/three", "has no dataset run/three; it holds"),
        ("outside", "outside is a link"),
        ("soft", "soft is a link"),
        ("virtual", "lies in other files"),
        ("run/../run/one", "has no dataset"),
    ):
        with pytest.raises(ValueError, match=message):
            importing.read(path, Hints(dataset=name, bits=12))
    with pytest.raises(ValueError, match=r"uint16 \[3, 5, 6\]; add bits= for codes, or transfer=linear"):
        importing.read(path, Hints(dataset="run/one"))
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match="not readable as HDF5"):
        importing.read(path, Hints(dataset="run/one", bits=12))
