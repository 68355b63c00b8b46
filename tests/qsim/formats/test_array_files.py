"""Tests photon cubes, zarr and visionsim: golden bytes and round trips at odd sizes."""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recordings import CAPTURE, SIZES, everything, one, random_planes

from qsim.file_order import numbered
from qsim.formats import array_files, exporting, importing
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints


def test_golden_photon_cube(tmp_path: Path):
    planes_ = one((1, 2, 10), (0, 0, 0), (0, 1, 9))
    array_files.write_cube(tmp_path / "a.npy", iter([planes_]), (1, 2, 10))
    cube = np.load(tmp_path / "a.npy")
    assert cube.tolist() == [[[128, 0], [0, 64]]]
    assert cube.dtype == np.uint8
    np.testing.assert_array_equal(everything(tmp_path / "a.npy", layout="cube", width=10), planes_)


@settings(max_examples=150, deadline=None)
@given(
    codes=st.integers(1, 70).flatmap(
        lambda width: hnp.arrays(
            np.uint8, st.tuples(st.integers(1, 4), st.integers(1, 9), st.just(width)), elements=st.integers(0, 1)
        )
    )
)
def test_photon_cubes_of_every_width(tmp_path_factory: pytest.TempPathFactory, codes: np.ndarray):
    path = tmp_path_factory.getbasetemp() / "cube.npy"
    array_files.write_cube(path, iter([codes]), codes.shape)
    np.testing.assert_array_equal(everything(path, layout="cube", width=codes.shape[2]), codes)
    whole = everything(path, layout="cube")
    assert whole.shape[2] == -(-codes.shape[2] // 8) * 8
    assert not whole[..., codes.shape[2] :].any()


@settings(max_examples=30, deadline=None)
@given(shape=SIZES, channels=st.integers(1, 3), seed=st.integers(0, 99))
def test_visionsim_folders_of_any_size(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], channels: int, seed: int
):
    folder = tmp_path_factory.mktemp("vs")
    expected = random_planes(*shape, channels, seed=seed)
    np.save(folder / "frames.npy", np.packbits(expected, axis=2))
    info = {"w": shape[2], "h": shape[1], "c": channels, "bitpack": True, "bitpack_dim": 2}
    (folder / "transforms.json").write_text(json.dumps(info))
    for channel in range(channels):
        np.testing.assert_array_equal(everything(folder, channel=channel), expected[..., channel])
    shutil.rmtree(folder)


@pytest.mark.parametrize("width", [7, 10, 16])
@pytest.mark.parametrize("sharded", [False, True])
def test_visionsim_folders(tmp_path: Path, width: int, sharded: bool):
    expected = random_planes(9, 5, width, 3)
    packed = np.packbits(expected, axis=2)
    if sharded:
        for n in range(3):
            np.save(tmp_path / f"{n:04d}.npy", packed[4 * n : 4 * n + 4])
    else:
        np.save(tmp_path / "frames.npy", packed)
    info = {"w": width, "h": 5, "c": 3, "bitpack": True, "bitpack_dim": 2}
    (tmp_path / "transforms.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="3 colour planes; choose one with channel="):
        importing.read(tmp_path)
    for channel in range(3):
        np.testing.assert_array_equal(everything(tmp_path, channel=channel), expected[..., channel])
    recording = importing.read(tmp_path, Hints(channel=1))
    np.testing.assert_array_equal(recording.read(3, 6), expected[3:6, ..., 1])
    (tmp_path / "transforms.json").write_text(json.dumps(info | {"w": width + 8}))
    with pytest.raises(ValueError, match="do not hold the width"):
        importing.read(tmp_path, Hints(channel=0))


def test_sums_of_visionsim_are_those_of_a_clocked_sensor(tmp_path: Path):
    """Sums of 7 planes have 3 bits; sums of 5 are read for a calibration, and are no codes of a stream."""
    sums = np.random.default_rng(0).integers(0, 6, (2, 5, 7, 1)).astype(np.uint8)
    np.save(tmp_path / "frames.npy", sums)
    info = {"w": 7, "h": 5, "c": 1, "bitpack": False}
    for planes, hints, message in [
        (7, {}, None),
        (7, {"bits": 3}, None),
        (5, {}, None),
        (0, {}, "sums of 0 bitplanes"),
        (2**17 - 1, {}, "sums of 131071 bitplanes"),
        (7, {"bits": 4}, "sums of 7 bitplanes have 3 bits, not 4; leave bits= out"),
        (None, {"bits": 4}, None),  # not stated: --bits says it
    ]:
        stated = {} if planes is None else {"bitplanes": planes}
        (tmp_path / "transforms.json").write_text(json.dumps(info | stated))
        if message is None:
            np.testing.assert_array_equal(everything(tmp_path, **hints), sums[..., 0])
        else:
            with pytest.raises(ValueError, match=message):
                everything(tmp_path, **hints)
    (tmp_path / "transforms.json").write_text(json.dumps(info | {"bitplanes": 5}))
    stream = importing.to_stream(importing.read(tmp_path, Hints(channel=0)), tmp_path / "s", importing.Import(100.0))
    assert stream.sensor.levels == 6


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("root", [False, True])
def test_zarr_of_both_versions(tmp_path: Path, version: int, root: bool):
    zarr = pytest.importorskip("zarr")
    expected = random_planes(11, 5, 7)
    path = str(tmp_path / "a.zarr")
    if root:
        array = zarr.open_array(path, mode="w", shape=expected.shape, chunks=(4, 5, 7), dtype="u1", zarr_format=version)
    else:
        group = zarr.open_group(path, mode="w", zarr_format=version)
        group.attrs["fps"] = 1000
        array = group.create_array("frames", shape=expected.shape, chunks=(4, 5, 7), dtype="u1")
    array[...] = expected
    recording = importing.read(Path(path))
    np.testing.assert_array_equal(recording.read(0, 11), expected)
    if not root:
        assert recording.source.attributes["fps"] == 1000


def test_zarr_without_frames_or_with_missing_chunks(tmp_path: Path):
    zarr = pytest.importorskip("zarr")
    zarr.open_group(str(tmp_path / "e.zarr"), mode="w").create_array("frames", shape=(0, 5, 7), dtype="u1")
    with pytest.raises(ValueError, match="has no frames"):
        importing.read(tmp_path / "e.zarr")
    array_files.write_zarr(tmp_path / "m.zarr", iter([random_planes(4, 5, 7)]), (4, 5, 7), {})
    shutil.rmtree(tmp_path / "m.zarr" / "frames" / "c")
    with pytest.raises(ValueError, match="0 of 1 chunks are there; the recording is incomplete"):
        importing.read(tmp_path / "m.zarr")


@pytest.mark.parametrize("name", ["zarr.json", "frames/zarr.json", "frames/c/0/0/0"])
def test_zarr_that_links_out_of_its_folder(tmp_path: Path, name: str):
    pytest.importorskip("zarr")
    array_files.write_zarr(tmp_path / "m.zarr", iter([random_planes(4, 5, 7)]), (4, 5, 7), {})
    file = tmp_path / "m.zarr" / name
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=f"{name}: is a link out of"):
        importing.read(tmp_path / "m.zarr")


def test_single_photon_challenge_cubes(tmp_path: Path):
    expected = random_planes(16, 6, 16, 3)
    np.save(tmp_path / "000.npy", np.packbits(expected, axis=2))
    np.testing.assert_array_equal(everything(tmp_path / "000.npy", layout="cube", channel=2), expected[..., 2])
    with pytest.raises(ValueError, match="a colour cube of 3 channels; choose one with channel=0"):
        importing.read(tmp_path / "000.npy", Hints("cube"))


def test_gzipped_cubes(tmp_path: Path):
    expected = random_planes(3, 5, 16)
    np.save(tmp_path / "a.npy", np.packbits(expected, axis=-1))
    (tmp_path / "a.npy.gz").write_bytes(gzip.compress((tmp_path / "a.npy").read_bytes()))
    np.testing.assert_array_equal(everything(tmp_path / "a.npy.gz"), expected)


@pytest.mark.parametrize("width", [10, 16])
def test_a_cube_that_we_wrote_comes_back_with_its_width(tmp_path: Path, width: int):
    """The description beside it states kind and width; another one beside a cube does not count."""
    expected = random_planes(4, 6, width)
    np.save(tmp_path / "p.npy", expected.astype(bool))
    stream = importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "s", CAPTURE)
    cube = exporting.export(stream, tmp_path / "cube.npy", Export("cube"))
    np.testing.assert_array_equal(everything(cube), expected)
    for foreign in ("[]", '{"shape": [4, 6, 9]}', "\xff"):
        (tmp_path / "cube.npy.json").write_text(foreign, encoding="latin-1")
        assert everything(cube, layout="cube").shape == (4, 6, 16)


def test_our_one_bit_stream_is_a_photon_cube_for_others(tmp_path: Path):
    """Read by the field's own tool, where its wheel is installed (`pip install photoncube`)."""
    photoncube = pytest.importorskip("photoncube", reason="the package photoncube is not installed")
    from PIL import Image

    expected = random_planes(4, 6, 16)
    np.save(tmp_path / "p.npy", expected.astype(bool))
    stream = importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "cube", CAPTURE)
    cube = photoncube.PhotonCube.open(str(stream.path))
    assert cube.shape == (4, 6, 2)
    cube.set_range(0, 4, 1)
    (tmp_path / "images").mkdir()
    cube.save_images(str(tmp_path / "images"))
    for image, plane in zip(numbered(list((tmp_path / "images").iterdir())), expected, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(image).convert("L")) > 0, plane > 0)
