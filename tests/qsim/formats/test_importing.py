"""Foreign files: golden bytes, round trips at odd sizes, ambiguity asked about, damage refused."""

import gzip
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import raw_planes
from clips import write_clip
from fakes import RECIPE, make
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from qsim.cli.program import main
from qsim.clip.clip import Clip
from qsim.clip.manifest import RELATIVE
from qsim.clip.sensing import Sensing, sense
from qsim.clip.stream import Stream
from qsim.clip.writer import ClipWriter
from qsim.colour import code_levels, from_linear, to_linear
from qsim.dataset import generation, recipe
from qsim.dataset.dataset import Dataset
from qsim.formats import array_files, detection, exporting, images, importing, video
from qsim.formats.exporting import Export
from qsim.formats.importing import Import
from qsim.formats.recording import Hints, Recording, numbered

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


# Golden bytes of formats known from the field


def test_golden_photon_cube(tmp_path: Path):
    planes_ = one((1, 2, 10), (0, 0, 0), (0, 1, 9))
    array_files.write_cube(tmp_path / "a.npy", iter([planes_]), (1, 2, 10))
    cube = np.load(tmp_path / "a.npy")
    assert cube.tolist() == [[[128, 0], [0, 64]]]
    assert cube.dtype == np.uint8
    np.testing.assert_array_equal(everything(tmp_path / "a.npy", layout="cube", width=10), planes_)


def test_golden_lsb_first_stream():
    assert list(np.packbits(one((1, 2, 10), (0, 0, 0), (0, 1, 9)).ravel(), bitorder="little")) == [1, 0, 8]
    assert list(raw_planes.half(one((1, 256, 512), (0, 0, 0), (0, 0, 9)))[:2]) == [1, 2]


def test_golden_spike():
    assert list(raw_planes.spike(one((1, 2, 8), (0, 1, 0)))) == [1, 0]


@pytest.mark.parametrize(
    ("y", "x", "byte", "value"),
    [(0, 0, 0, 1), (0, 127, 15, 0x80), (0, 128, 32, 1), (255, 0, 32640, 1), (256, 0, 32656, 1), (511, 0, 16, 1),
     (511, 511, 127, 0x80)],
)  # fmt: skip
def test_golden_swissspad2_full(tmp_path: Path, y: int, x: int, byte: int, value: int):
    raw = bytearray(32768)
    raw[byte] = value
    (tmp_path / "a.bin").write_bytes(raw)
    expected = one((1, 512, 512), (0, y, x))
    np.testing.assert_array_equal(everything(tmp_path / "a.bin", layout="swissspad2-full"), expected)
    assert raw_planes.full(expected) == bytes(raw)


def test_golden_spad512s():
    assert raw_planes.spad512s(one((1, 512, 512), (0, 0, 0)))[:2] == b"\x80\x00"


# Round trips


@settings(max_examples=150, deadline=None)
@given(
    codes=st.integers(1, 70).flatmap(
        lambda width: hnp.arrays(np.uint8, st.tuples(st.integers(1, 4), st.integers(1, 9), st.just(width)),
                                 elements=st.integers(0, 1))
    )
)  # fmt: skip
def test_photon_cubes_of_every_width(tmp_path_factory: pytest.TempPathFactory, codes: np.ndarray):
    path = tmp_path_factory.getbasetemp() / "cube.npy"
    array_files.write_cube(path, iter([codes]), codes.shape)
    np.testing.assert_array_equal(everything(path, layout="cube", width=codes.shape[2]), codes)
    whole = everything(path, layout="cube")
    assert whole.shape[2] == -(-codes.shape[2] // 8) * 8
    assert not whole[..., codes.shape[2] :].any()


@pytest.mark.parametrize("bits", range(1, 9))
@pytest.mark.parametrize("width", [1, 7, 10, 33, 70])
def test_codes_through_our_stream_and_every_export(tmp_path: Path, bits: int, width: int):
    codes = np.random.default_rng(bits).integers(0, 2**bits, (3, 5, width)).astype(np.uint8)
    codes[0, 0, 0], codes[0, 1, 0], codes[0, 2, 0] = 0, 1, 2**bits - 1
    np.save(tmp_path / "codes.npy", codes)
    recording = importing.read(tmp_path / "codes.npy", Hints("codes", bits=bits))
    stream = importing.to_stream(recording, tmp_path / "s", CAPTURE)
    np.testing.assert_array_equal(stream.codes(), codes)
    np.testing.assert_array_equal(
        stream.codes(1, 3, (1, width // 2, 3, width - width // 2)), codes[1:, 1:4, width // 2 :]
    )
    exports = [Export("png"), Export("zarr")] + ([Export("cube")] if bits == 1 else [])
    for wanted in exports:
        path = exporting.export(stream, tmp_path / wanted.kind, wanted)
        layout = {"png": "png", "zarr": "zarr", "cube": "cube"}[wanted.kind]
        np.testing.assert_array_equal(everything(path, layout=layout, **said(layout, bits, width)), codes)
        side = path / "meta.json" if path.is_dir() else path.with_name(path.name + ".json")
        meta = json.loads(side.read_text())
        assert (meta["bits"], meta["width"], meta["code_model"], meta["format_version"]) == (
            bits,
            width,
            "binary_sum",
            1,
        )


def said(kind: str, bits: int, width: int) -> dict[str, int]:
    """What has to be said to read an export of codes again: a hint that says nothing is refused."""
    return {"width": width} if kind == "cube" else {} if kind == "png" and bits == 1 else {"bits": bits}


SIZES = st.tuples(st.integers(1, 5), st.integers(1, 9), st.integers(1, 70))


@settings(max_examples=30, deadline=None)
@given(shape=SIZES, bits=st.integers(1, 16), seed=st.integers(0, 99))
def test_codes_of_any_size_and_depth_come_back(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], bits: int, seed: int
):
    """Stream -> PNG, zarr (and cube, MATLAB's parts) -> the same codes, whatever the size."""
    folder = tmp_path_factory.mktemp("any")
    values = np.random.default_rng(seed).integers(0, 2**bits, shape).astype(np.uint8 if bits <= 8 else np.uint16)
    np.save(folder / "codes.npy", values)
    stream = importing.to_stream(importing.read(folder / "codes.npy", Hints("codes", bits=bits)), folder / "s", CAPTURE)
    np.testing.assert_array_equal(stream.codes(), values)
    assert (stream.meta["bit_order"], stream.meta["orientation"], stream.meta["width"]) == ("msb", "upright", shape[2])
    for kind in ("png", "zarr", "cube") if bits == 1 else ("png", "zarr"):
        path = exporting.export(stream, folder / kind, Export(kind))
        np.testing.assert_array_equal(everything(path, layout=kind, **said(kind, bits, shape[2])), values)
    if bits <= 8:
        from scipy.io import savemat

        cut = seed % shape[0]  # parts of unequal length, or one part alone
        for k, part in enumerate([values[:cut], values[cut:]] if cut else [values], 1):
            (folder / "mat").mkdir(exist_ok=True)
            savemat(folder / "mat" / f"part_{k}.mat", {"OUTPUT": part.transpose(1, 2, 0)})
        np.testing.assert_array_equal(everything(folder / "mat", bits=bits), values)
    shutil.rmtree(folder)


@settings(max_examples=15, deadline=None)
@given(shape=SIZES, seed=st.integers(0, 99))
def test_light_of_any_size_comes_back(tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], seed: int):
    """Clip -> EXR and zarr exactly, lossless mp4 and PNG to half a step of 8 bits."""
    from qsim.clip import exr

    pytest.importorskip("av")
    zarr = pytest.importorskip("zarr")
    folder = tmp_path_factory.mktemp("light")
    light = np.random.default_rng(seed).random(shape).astype(np.float16).astype(np.float32)
    clip = clip_of(folder / "c", light)
    path = exporting.export(clip, folder / "exr", Export("exr"))
    np.testing.assert_array_equal(np.stack([exr.read(path / f"{t:06d}.exr")["Y"] for t in range(shape[0])]), light)
    path = exporting.export(clip, folder / "z", Export("zarr"))
    np.testing.assert_array_equal(zarr.open_group(str(path), mode="r")["frames"][...], light)
    for kind in ("mp4", "png"):
        path = exporting.export(clip, folder / f"c.{kind}", Export(kind, transfer="linear", white=1.0))
        np.testing.assert_allclose(everything(path, transfer="linear"), light, atol=0.5 / 255 + 1e-6)
    shutil.rmtree(folder)


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


@pytest.mark.parametrize("kind", ["half", "full", "spad512s", "spad512s with footer"])
@pytest.mark.parametrize("frames", [1, 3])
def test_raw_camera_files(tmp_path: Path, kind: str, frames: int):
    height = 256 if kind == "half" else 512
    expected = random_planes(frames, height, 512)
    encode = {"half": raw_planes.half, "full": raw_planes.full}.get(kind, raw_planes.spad512s)
    layout = {"half": "swissspad2-half", "full": "swissspad2-full"}.get(kind, "spad512s")
    content = encode(expected) + (b"\0\0\0\0" if "footer" in kind else b"")
    (tmp_path / "a.bin").write_bytes(content)
    np.testing.assert_array_equal(everything(tmp_path / "a.bin", layout=layout), expected)
    for wrong in (content[:-1], content + b"\0", b""):
        (tmp_path / "a.bin").write_bytes(wrong)
        with pytest.raises(ValueError, match=rf"a\.bin: {len(wrong)} bytes are not a whole number"):
            importing.read(tmp_path / "a.bin", Hints(layout))


def test_numbered_files_are_read_in_the_order_of_their_numbers(tmp_path: Path):
    expected = random_planes(22, 256, 512)
    for n in range(11):
        folder = tmp_path / "0" / str(n // 4)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"filename{n}.bin").write_bytes(raw_planes.half(expected[2 * n : 2 * n + 2]))
    recording = importing.read(tmp_path, Hints("swissspad2-half"))
    assert recording.shape == (22, 256, 512)
    np.testing.assert_array_equal(recording.read(0, 22), expected)
    np.testing.assert_array_equal(recording.read(5, 13), expected[5:13])
    assert [p.name for p in numbered([Path("a10.png"), Path("a9.png"), Path("a1.png")])] == [
        "a1.png",
        "a9.png",
        "a10.png",
    ]


@settings(max_examples=40, deadline=None)
@given(height=st.integers(1, 12), width=st.integers(1, 5).map(lambda n: 8 * n), seed=st.integers(0, 99))
def test_spike_files(tmp_path_factory: pytest.TempPathFactory, height: int, width: int, seed: int):
    folder = tmp_path_factory.getbasetemp()
    expected = random_planes(3, height, width, seed=seed)
    path = folder / "a.dat"
    path.write_bytes(raw_planes.spike(expected))
    np.testing.assert_array_equal(everything(path, height=height, width=width), expected)
    np.testing.assert_array_equal(everything(path, height=height, width=width, columns=width - 1), expected[..., :-1])


def test_spike_size_from_the_side_file(tmp_path: Path):
    expected = random_planes(2, 6, 8)
    (tmp_path / "a.dat").write_bytes(raw_planes.spike(expected))
    with pytest.raises(ValueError, match="does not hold its size"):
        importing.read(tmp_path / "a.dat")
    (tmp_path / "config.yaml").write_text("data:\n  spike_h: 6\n  spike_w: 8\n")
    np.testing.assert_array_equal(everything(tmp_path / "a.dat"), expected)
    with pytest.raises(ValueError, match="12 bytes are not a whole number"):
        importing.read(tmp_path / "a.dat", Hints(height=5, width=8))


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
        assert recording.meta["attributes"]["fps"] == 1000


def test_zarr_without_frames_or_with_missing_chunks(tmp_path: Path):
    zarr = pytest.importorskip("zarr")
    zarr.open_group(str(tmp_path / "e.zarr"), mode="w").create_array("frames", shape=(0, 5, 7), dtype="u1")
    with pytest.raises(ValueError, match="has no frames"):
        importing.read(tmp_path / "e.zarr")
    array_files.write_zarr(tmp_path / "m.zarr", iter([random_planes(4, 5, 7)]), (4, 5, 7), {})
    shutil.rmtree(tmp_path / "m.zarr" / "frames" / "c")
    with pytest.raises(ValueError, match="0 of 1 chunks are there; the recording is incomplete"):
        importing.read(tmp_path / "m.zarr")


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
    with pytest.raises(FileNotFoundError, match=r"part_2\.mat: missing, though info\.json speaks of 2 parts"):
        importing.read(tmp_path)


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
    with pytest.raises(ValueError, match="3 colour planes; choose one with --channel"):
        importing.read(tmp_path)
    for channel in range(3):
        np.testing.assert_array_equal(everything(tmp_path, channel=channel), expected[..., channel])
    recording = importing.read(tmp_path, Hints(channel=1))
    np.testing.assert_array_equal(recording.read(3, 6), expected[3:6, ..., 1])
    (tmp_path / "transforms.json").write_text(json.dumps(info | {"w": width + 8}))
    with pytest.raises(ValueError, match="do not hold the width"):
        importing.read(tmp_path, Hints(channel=0))


def test_single_photon_challenge_cubes(tmp_path: Path):
    expected = random_planes(16, 6, 16, 3)
    np.save(tmp_path / "000.npy", np.packbits(expected, axis=2))
    np.testing.assert_array_equal(everything(tmp_path / "000.npy", layout="cube", channel=2), expected[..., 2])
    with pytest.raises(ValueError, match="a colour cube of 3 channels; choose one with --channel 0"):
        importing.read(tmp_path / "000.npy", Hints("cube"))


def test_gzipped_cubes(tmp_path: Path):
    expected = random_planes(3, 5, 16)
    np.save(tmp_path / "a.npy", np.packbits(expected, axis=-1))
    (tmp_path / "a.npy.gz").write_bytes(gzip.compress((tmp_path / "a.npy").read_bytes()))
    np.testing.assert_array_equal(everything(tmp_path / "a.npy.gz"), expected)


def test_flips(tmp_path: Path):
    expected = random_planes(2, 512, 512)
    (tmp_path / "acq_0.bin").write_bytes(raw_planes.spad512s(expected))
    np.testing.assert_array_equal(everything(tmp_path / "acq_0.bin", flip="lr"), expected[..., ::-1])
    np.testing.assert_array_equal(everything(tmp_path / "acq_0.bin", flip="ud"), expected[:, ::-1])


# Which bit comes first, and which way is up


@pytest.mark.parametrize(
    ("layout", "size", "row"),
    [("swissspad2-half", (256, 512), 0), ("swissspad2-full", (512, 512), 0), ("spad512s", (512, 512), 0),
     ("spike", (6, 8), 5)],
)  # fmt: skip
def test_the_bit_order_of_raw_files_is_said_as_it_is_read(tmp_path: Path, layout: str, size: tuple[int, int], row: int):
    """The first bit in the said order is the left pixel of the top row, or of the bottom row if it says upside down."""
    raw = np.zeros(size[0] * size[1] // 8, np.uint8)
    hints = Hints(layout, height=size[0], width=size[1]) if layout == "spike" else Hints(layout)
    raw.tofile(tmp_path / "a.raw")
    said = importing.read(tmp_path / "a.raw", hints).meta
    assert ("upside down, turned upright" in said["orientation"]) == (row > 0)
    raw[0] = {"msb": 0x80, "lsb": 0x01}[said["bit_order"]]
    raw.tofile(tmp_path / "a.raw")
    np.testing.assert_array_equal(importing.read(tmp_path / "a.raw", hints).read(0, 1), one((1, *size), (0, row, 0)))


def sample(folder: Path, layout: str) -> tuple[Path, Hints]:
    """A small recording of each layout, and what has to be said to read it."""
    planes_ = random_planes(2, 16, 16)
    path = folder / "a.npy"
    if layout == "cube":
        np.save(path, np.packbits(planes_, axis=2))
    elif layout in ("codes", "light"):
        np.save(path, planes_.astype(bool if layout == "codes" else np.float32))
    elif layout == "video":
        pytest.importorskip("av")
        path = folder / "a.mp4"
        video.write_video(path, iter(255 * planes_), 30, lossless=True)
    elif layout == "png":
        path = folder
        images.write_png(folder, iter(planes_.astype(bool)))
    elif layout == "tiff":
        path = folder / "a.tif"
        pytest.importorskip("tifffile").imwrite(path, planes_[0].astype(bool))
    elif layout == "visionsim":
        path = folder
        np.save(folder / "frames.npy", np.packbits(planes_[..., None], axis=2))
        (folder / "transforms.json").write_text('{"w": 16, "h": 16, "c": 1, "bitpack": true, "bitpack_dim": 2}')
    elif layout == "zarr":
        pytest.importorskip("zarr")
        path = folder / "a.zarr"
        array_files.write_zarr(path, iter([planes_]), (2, 16, 16), {})
    elif layout == "mat":
        from scipy.io import savemat

        path = folder / "a.mat"
        savemat(path, {"OUTPUT": planes_.transpose(1, 2, 0)})
    else:
        path = folder / "a.bin"
        path.write_bytes(bytes(64 if layout == "spike" else 32768))
    needed: dict[str, Any] = {"spike": {"height": 16, "width": 16}, "cube": {"width": 16}, "visionsim": {}}
    light = layout in ("light", "video")  # the pictures hold one bit
    return path, Hints(layout, **({"transfer": "linear"} if light else needed.get(layout, {})))


def promised() -> dict[str, tuple[str, str]]:
    """(bit order, orientation) of every layout, in the words of the readers, from the table in docs/files.md."""
    text = (Path(__file__).parents[3] / "docs" / "files.md").read_text(encoding="utf-8")
    found = {}
    for names, _, bits, rows in re.findall(r"^\| (`.*?) \| (.*?) \| ?(.*?) \| (.*?) \|$", text, re.MULTILINE):
        order = "msb" if "highest" in bits else "lsb" if "lowest" in bits else "none"
        for name in re.findall(r"`([\w-]+)`", names):
            found[name] = order, rows.removesuffix(", rows padded").removesuffix(": `--flip lr`")
    return found


@pytest.mark.parametrize("layout", detection.LAYOUTS)
def test_every_reader_says_bit_order_and_orientation(tmp_path: Path, layout: str):
    """As promised in docs/files.md, in what is read and in what is made of it."""
    (tmp_path / "in").mkdir()
    recording = importing.read(*sample(tmp_path / "in", layout))
    make = importing.to_clip if recording.is_light else importing.to_stream
    made = make(recording, tmp_path / "made", CAPTURE)
    order, rows = promised()[layout]
    assert recording.meta["bit_order"].startswith(order)
    assert recording.meta["orientation"].startswith(rows)
    said = {key: recording.meta[key] for key in ("bit_order", "orientation")}
    assert made.meta["source"] == made.meta["source"] | said
    assert made.meta.get("orientation", said["orientation"]) == said["orientation"]
    exported = exporting.export(made, tmp_path / "out", Export("png"))
    assert json.loads((exported / "meta.json").read_text())["orientation"] == said["orientation"]


def test_a_disputed_side_stays_disputed_and_a_flip_is_remembered(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(bytes(32768))
    disputed = "as stored, left and right are disputed"
    for flip, said in [("none", disputed), ("lr", f"{disputed}; then --flip lr")]:
        stream = importing.to_stream(
            importing.read(tmp_path / "a.bin", Hints("spad512s", flip=flip)), tmp_path / flip, CAPTURE
        )
        assert (stream.meta["orientation"], stream.meta["source"]["flip_lr"]) == (said, "unknown")
        cube = exporting.export(stream, tmp_path / f"{flip}_cube.npy", Export("cube"))
        assert json.loads(cube.with_name(cube.name + ".json").read_text())["orientation"] == said
    np.save(tmp_path / "light.npy", np.ones((2, 3, 4), np.float32))
    clip = importing.to_clip(importing.read(tmp_path / "light.npy", Hints(flip="ud")), tmp_path / "clip", CAPTURE)
    assert clip.meta["source"]["orientation"] == "upright; then --flip ud"
    sensed, _ = sense(clip, Sensing("quiver-physical", ppp=3.25))
    assert sensed.meta["orientation"] == "upright; then --flip ud"


def test_footage_whose_reader_says_nothing_is_not_called_upright(tmp_path: Path):
    recording = Recording((1, 2, 8), lambda start, stop: random_planes(stop - start, 2, 8), "somewhere", 1)
    assert importing.to_stream(recording, tmp_path / "s", CAPTURE).meta["orientation"] == "unknown"


# Pictures and video


@pytest.mark.parametrize("transfer", ["linear", "srgb", "gamma 2.2"])
@pytest.mark.parametrize("top", [255, 65535])
def test_transfer_curves_are_inverted_exactly(transfer: str, top: int):
    coded = np.arange(top + 1)
    linear = to_linear(coded, transfer, top)
    assert (np.diff(linear) >= 0).all()
    assert (linear[0], linear[-1]) == (0, pytest.approx(1))
    back = from_linear(linear, transfer, top).astype(int)
    assert np.abs(back - coded).max() <= (0 if top == 255 else 1)


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


def test_png_and_tiff_pictures_of_light(tmp_path: Path):
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(0)
    for dtype in (np.uint8, np.uint16):
        pictures = rng.integers(0, np.iinfo(dtype).max, (3, 9, 7)).astype(dtype)
        folder = tmp_path / f"png{np.dtype(dtype).name}"
        folder.mkdir()
        images.write_png(folder, iter(pictures))
        expected = to_linear(pictures, "srgb", np.iinfo(dtype).max)
        np.testing.assert_array_equal(everything(folder, transfer="srgb"), expected)
        for photometric, stored in [("minisblack", pictures), ("miniswhite", np.iinfo(dtype).max - pictures)]:
            path = tmp_path / f"{photometric}.tif"
            tifffile.imwrite(path, stored, photometric=photometric)
            np.testing.assert_array_equal(everything(path, transfer="srgb"), expected)
        with pytest.raises(ValueError, match="does not say how light was coded"):
            importing.read(folder)


def test_colour_becomes_luminance(tmp_path: Path):
    from PIL import Image

    colour = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(np.uint8)
    Image.fromarray(colour).save(tmp_path / "a.png")
    expected = to_linear(colour, "gamma 2.2", 255) @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(everything(tmp_path / "a.png", transfer="gamma 2.2")[0], expected, rtol=1e-5)


def test_codes_in_pictures(tmp_path: Path):
    """One-bit PNG, codes as they are, stretched codes; a stretched file is refused unless it is said."""
    bits1 = random_planes(2, 5, 7).astype(bool)
    codes = np.random.default_rng(1).integers(0, 8, (2, 5, 7)).astype(np.uint8)
    codes[0, 0, :2] = 0, 7
    for name, pictures in [("one", bits1), ("three", codes), ("wide", code_levels(codes, 3))]:
        (tmp_path / name).mkdir()
        images.write_png(tmp_path / name, iter(pictures))
    np.testing.assert_array_equal(everything(tmp_path / "one"), bits1)
    np.testing.assert_array_equal(everything(tmp_path / "three", bits=3), codes)
    np.testing.assert_array_equal(everything(tmp_path / "wide", bits=3, stretched=True), codes)
    with pytest.raises(ValueError, match=r"value \d+ at \(t, y, x\) = .* is no 3-bit code .* --stretched"):
        everything(tmp_path / "wide", bits=3)
    lossy = code_levels(codes, 3)
    lossy[1, 2, 3] ^= 2
    (tmp_path / "lossy").mkdir()
    images.write_png(tmp_path / "lossy", iter(lossy))
    with pytest.raises(ValueError, match=r"\(t, y, x\) = \(1, 2, 3\).*coded with loss"):
        everything(tmp_path / "lossy", bits=3, stretched=True)


def test_one_bit_tiff_of_both_polarities(tmp_path: Path):
    tifffile = pytest.importorskip("tifffile")
    bits = random_planes(1, 5, 11)[0].astype(bool)
    for photometric, stored in [("minisblack", bits), ("miniswhite", ~bits)]:
        path = tmp_path / f"{photometric}.tif"
        tifffile.imwrite(path, stored, photometric=photometric)
        np.testing.assert_array_equal(everything(path)[0], bits)


def test_lossless_video_is_bit_exact_and_ordinary_video_is_not(tmp_path: Path):
    """A noisy 8-bit clip through our writer and back; the lossy default must differ, or the test tests nothing."""
    pytest.importorskip("av")
    codes = np.random.default_rng(0).integers(0, 8, (6, 34, 46)).astype(np.uint8)
    np.save(tmp_path / "c.npy", codes)
    stream = importing.to_stream(importing.read(tmp_path / "c.npy", Hints("codes", bits=3)), tmp_path / "s", CAPTURE)
    exact = exporting.export(stream, tmp_path / "exact.mp4", Export("mp4"))
    found = everything(exact, transfer="linear") * 255
    np.testing.assert_array_equal(np.rint(found), code_levels(codes, 3))
    lossy = exporting.export(stream, tmp_path / "lossy.mp4", Export("mp4", lossless=False))
    difference = np.rint(everything(lossy, transfer="linear") * 255) - code_levels(codes, 3)
    assert np.abs(difference).max() > 8
    assert json.loads((tmp_path / "exact.mp4.json").read_text())["frame_rate"] == 1000.0


def test_odd_sizes_of_video(tmp_path: Path):
    pytest.importorskip("av")
    frames = np.random.default_rng(0).random((3, 17, 23)).astype(np.float16).astype(np.float32)
    clip = clip_of(tmp_path / "c", frames)
    path = exporting.export(clip, tmp_path / "c.mp4", Export("mp4", white=1.0))
    np.testing.assert_array_equal(
        np.rint(everything(path, transfer="linear") * 255), from_linear(frames, "gamma 2.2", 255)
    )
    with pytest.raises(ValueError, match=r"lossy H\.264 needs even sizes"):
        exporting.export(clip, tmp_path / "l.mp4", Export("mp4", lossless=False))
    assert not (tmp_path / "l.mp4").exists()


def test_a_folder_of_videos_becomes_clips(tmp_path: Path):
    pytest.importorskip("av")
    frames = np.random.default_rng(0).random((2, 16, 24))
    clip = clip_of(tmp_path / "c", frames)
    for name in ("test_00000.mp4", "occ/a.mp4"):
        exporting.export(clip, tmp_path / "in" / name, Export("mp4", white=1.0))
    options = ["--frame-rate", "2000", "--transfer", "gamma 2.2", "--split", "test"]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), *options]) == 0
    found = Clip.open(tmp_path / "out" / "occ_a")
    assert found.meta["split"] == "test"
    assert found.camera is None
    np.testing.assert_allclose(found.radiance(1), clip.radiance(1), atol=0.012)  # half a step of 8 bits at the top
    assert Clip.open(tmp_path / "out" / "test_00000").frame_rate == 2000.0


def test_a_tree_of_picture_folders_becomes_clips(tmp_path: Path):
    """As X4K1000FPS's test set has it: test/Type1/TEST01/0000.png ..."""
    pictures = np.random.default_rng(0).integers(0, 255, (3, 9, 7)).astype(np.uint8)
    for n, name in enumerate(["Type1/TEST01_000_f0433", "Type1/TEST02", "Type2/v1.0"]):
        (tmp_path / "in" / name).mkdir(parents=True)
        images.write_png(tmp_path / "in" / name, iter(pictures[: n + 1]))
    (tmp_path / "in" / "scene").mkdir()  # planes with their pictures beside them are another kind
    np.save(tmp_path / "in" / "scene" / "0.npy", np.zeros((2, 3, 4), np.uint8))
    images.write_png(tmp_path / "in" / "scene", iter(pictures))
    options = ["--frame-rate", "1000", "--transfer", "srgb", "--split", "test"]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), *options]) == 0
    found = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert found == ["Type1_TEST01_000_f0433", "Type1_TEST02", "Type2_v1.0"]
    clip = Clip.open(tmp_path / "out" / "Type2_v1.0")
    assert clip.shape == (3, 9, 7)
    np.testing.assert_allclose(clip.radiance(2), to_linear(pictures[2], "srgb", 255), rtol=2**-10)
    assert main(["convert", str(tmp_path / "in" / "Type2" / "v1.0"), str(tmp_path / "one"), *options]) == 0
    assert Clip.open(tmp_path / "one").shape == (3, 9, 7)


COLOURS = np.array([(200, 30, 40), (30, 180, 60), (40, 50, 220), (210, 200, 50), (60, 190, 200), (120, 120, 120)])
MATRICES = {
    "bt709": (1, 0.2126, 0.0722),
    "bt601": (5, 0.299, 0.114),
    "untagged": (None, 0.299, 0.114),
}  # tag, red, blue


def mosaics(colours: np.ndarray, side: int = 16) -> np.ndarray:
    """Frames [T, H, W, 3] of squares: every frame begins with another colour."""
    n = len(colours)
    grid = (np.arange(n)[:, None, None] + 2 * np.arange(2)[:, None] + np.arange(3)) % n
    return colours[grid].repeat(side, axis=1).repeat(side, axis=2)


def to_ycbcr(rgb: np.ndarray, matrix: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Y, Cb, Cr of colours by the formulae of BT.601 and BT.709; Cb and Cr are 0 for grey."""
    _, red, blue = MATRICES[matrix]
    luma = rgb @ np.array([red, 1 - red - blue, blue])
    return luma, (rgb[..., 2] - luma) / (2 * (1 - blue)), (rgb[..., 0] - luma) / (2 * (1 - red))


def from_ycbcr(luma: np.ndarray, cb: np.ndarray, cr: np.ndarray, matrix: str) -> np.ndarray:
    """The inverse of `to_ycbcr`."""
    _, red, blue = MATRICES[matrix]
    ends = luma + 2 * (1 - red) * cr, luma + 2 * (1 - blue) * cb
    return np.stack([ends[0], (luma - red * ends[0] - blue * ends[1]) / (1 - red - blue), ends[1]], axis=-1)


def write_colour_video(path: Path, rgb: np.ndarray, matrix: str, full_range: bool) -> None:
    """H.264 in 4:2:0 without loss of its own; FFmpeg converts no colours here, it would share its mistakes."""
    import av

    tag = MATRICES[matrix][0]
    luma_scale, chroma_scale, black = (1.0, 1.0, 0) if full_range else (219 / 255, 224 / 255, 16)
    luma, *chroma = to_ycbcr(rgb, matrix)
    layers = [luma * luma_scale + black] + [c[:, ::2, ::2] * chroma_scale + 128 for c in chroma]
    flat = np.concatenate([np.rint(layer).astype(np.uint8).reshape(len(rgb), -1) for layer in layers], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.height, stream.width = rgb.shape[1:3]
        stream.codec_context.pix_fmt = "yuv420p"
        for image in flat.reshape(len(rgb), -1, rgb.shape[2]):
            picture = av.VideoFrame.from_ndarray(image, format="yuv420p")
            if tag is not None:
                picture.colorspace = stream.codec_context.colorspace = tag
            if tag is not None or full_range:
                picture.color_range = stream.codec_context.color_range = 2 if full_range else 1
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def luminance(rgb: np.ndarray, transfer: str) -> np.ndarray:
    """Rec. 709 luminance of colours 0 ... 255, linearised before they are weighted, in double precision."""
    coded = np.clip(np.asarray(rgb, float), 0, 255) / 255
    srgb = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    return (srgb if transfer == "srgb" else coded**2.2) @ np.array([0.2126, 0.7152, 0.0722])


def decoded(rgb: np.ndarray, matrix: str, full_range: bool) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest [R, G, B] that a decoder may return for colours sent as 8-bit YCbCr.

    Y, Cb and Cr are each rounded by half a code at most. FFmpeg's ordinary converter then cuts the fraction off every
    term of R = Y + a Cr, B = Y + b Cb and G = Y - c Cb - d Cr: up to 2, 2 and 3 codes less, never more.
    """
    _, red, blue = MATRICES[matrix]
    green = 1 - red - blue
    luma, chroma = (0.5, 0.5) if full_range else (0.5 * 255 / 219, 0.5 * 255 / 224)
    of_red, of_blue = 2 * (1 - red) * chroma, 2 * (1 - blue) * chroma
    rounding = luma + np.array([of_red, (red * of_red + blue * of_blue) / green, of_blue])
    return rgb - rounding - np.array([2, 3, 2]), rgb + rounding


@pytest.mark.parametrize("transfer", ["srgb", "gamma 2.2"])
@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("matrix", MATRICES)
def test_colour_video_becomes_linear_luminance(tmp_path: Path, matrix: str, full_range: bool, transfer: str):
    """As docs/files.md promises, for folders as I2-2000FPS and X4K1000FPS come: 8-bit colour H.264 in 4:2:0.

    Squares of one colour, without a rim of 4 pixels: chroma has half the pixels, and interpolation takes up to two of
    them from the next square. What is left differs from the known colour by the rounding of YCbCr (`decoded`), and by
    that of half precision in the clip. Channels in another order, weights before the curve, and the other matrix must
    lie outside, or the test could not tell them.
    """
    pytest.importorskip("av")
    rgb = mosaics(COLOURS)
    write_colour_video(tmp_path / "in" / "scene" / "clip.mp4", rgb, matrix, full_range)
    options = ["--frame-rate", "2000", "--transfer", transfer, "--split", "train"]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), *options]) == 0
    clip = Clip.open(tmp_path / "out" / "scene_clip")
    assert (clip.shape, clip.meta["split"], clip.meta["source"]["transfer"]) == (rgb.shape[:3], "train", transfer)
    inside = np.abs(np.arange(rgb.shape[2]) % 16 - 7.5) < 4
    kept = np.outer(inside[: rgb.shape[1]], inside)
    found = np.stack([clip.radiance(t) for t in range(len(clip))])[:, kept]
    colours = rgb[:, kept].astype(float)
    low, high = (luminance(bound, transfer) for bound in decoded(colours, matrix, full_range))
    low, high = low * (1 - 2**-11), high * (1 + 2**-11)
    assert ((low <= found) & (found <= high)).all()
    weighted_first = (colours @ np.array([0.2126, 0.7152, 0.0722]))[..., None].repeat(3, axis=-1)
    other_matrix = from_ycbcr(*to_ycbcr(colours, matrix), "bt601" if matrix == "bt709" else "bt709")
    for wrong in (colours[..., ::-1], weighted_first, other_matrix):
        light = luminance(wrong, transfer)
        assert ((light < low) | (light > high)).any()


def test_a_data_set_becomes_videos(tmp_path: Path):
    """`convert DATASET --to mp4`: a file per clip in the folder of its split, grey values rounded to half a code."""
    av = pytest.importorskip("av")
    generation.generate(recipe.parse(RECIPE), tmp_path / "small", generation.Options(workers=0), make=make)
    command = ["convert", str(tmp_path / "small"), str(tmp_path / "out"), "--to", "mp4"]
    assert main(command) == 0
    clips = Dataset.open(tmp_path / "small").clips()
    names = {f"{clip.meta['split']}/{clip.name}.mp4": clip for clip in clips}
    assert sorted(names) == ["test/tumble_0004.mp4", "train/fan_0000.mp4", "train/fan_0001.mp4"]
    made = [str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")]
    assert sorted(made) == sorted([*names, *(f"{name}.json" for name in names)])
    for name, clip in names.items():
        meta = json.loads((tmp_path / "out" / f"{name}.json").read_text())
        assert (meta["shape"], meta["frame_rate"], meta["split"]) == ([*clip.shape], 2000.0, clip.meta["split"])
        assert (meta["orientation"], meta["transfer"], meta["lossless"]) == ("upright", "gamma 2.2", True)
        radiance = np.stack([clip.radiance(t) for t in range(len(clip))]).astype(float)
        assert meta["white"] == pytest.approx(np.percentile(radiance[:, ::2, ::2], 99.9), rel=1e-6)
        exact = 255 * np.clip(radiance / meta["white"], 0, 1) ** (1 / 2.2)
        with av.open(str(tmp_path / "out" / name)) as container:
            grey = np.stack([frame.to_ndarray(format="gray") for frame in container.decode(video=0)])
        assert grey.shape == clip.shape
        assert np.abs(grey - exact).max() <= 0.5 + 1e-6
    assert main(command) == 2, "what is there is not replaced without --force"
    assert main([*command, "--force"]) == 0


def test_light_out_as_exr_png_and_zarr(tmp_path: Path):
    from qsim.clip import exr

    frames = np.random.default_rng(0).random((3, 9, 7)).astype(np.float16).astype(np.float32)
    clip = clip_of(tmp_path / "c", frames)
    folder = exporting.export(clip, tmp_path / "exr", Export("exr"))
    np.testing.assert_array_equal(exr.read(folder / "000002.exr")["Y"], frames[2])
    folder = exporting.export(clip, tmp_path / "png", Export("png", transfer="srgb", white=1.0))
    np.testing.assert_allclose(everything(folder, transfer="srgb"), frames, atol=0.005)
    zarr = pytest.importorskip("zarr")
    folder = exporting.export(clip, tmp_path / "c.zarr", Export("zarr"))
    np.testing.assert_array_equal(zarr.open_group(str(folder), mode="r")["frames"][...], frames)


def test_the_ball_becomes_a_clip_of_relative_light(tmp_path: Path):
    """A falling ball at 30 000 fps, 12 bits in 16: half precision keeps it to 1 part in 2048."""
    with np.load(Path(__file__).parents[2] / "data" / "ball_12bit.npz") as archive:
        stored = archive["frames"][:3]
    np.save(tmp_path / "ball.npy", stored)
    line = f"convert {tmp_path}/ball.npy {tmp_path}/ball --frame-rate 30000 --exposure 20e-6 --transfer linear"
    assert main(line.split()) == 0
    clip = Clip.open(tmp_path / "ball")
    assert clip.shape == stored.shape
    assert clip.meta["radiance_unit"] == RELATIVE
    assert (clip.frame_rate, clip.exposure) == (30000.0, 20e-6)
    np.testing.assert_allclose(clip.radiance(1), stored[1] / 65535, rtol=2**-11)
    assert main(["sense", str(tmp_path / "ball"), "--bits", "3", "--ppp", "3.25"]) == 0


# What a file does not say


def test_three_raw_layouts_of_one_size_are_not_guessed(tmp_path: Path):
    """Evidence is shown (here the right reading is the smoothest), the decision is the user's."""
    bright = 0.3 + 0.25 * np.sin(2 * np.pi * np.arange(512) / 32)
    waves = (np.random.default_rng(0).random((256, 512, 512), np.float32) < bright).astype(np.uint8)
    path = tmp_path / "capture.bin"
    path.write_bytes(raw_planes.spad512s(waves))
    assert path.stat().st_size == 8_388_608
    with pytest.raises(ValueError, match=r"8388608 bytes fit .*; choose one with --layout") as caught:
        importing.read(path)
    evidence = dict(re.findall(r"([\w-]+) \(roughness ([\d.]+)\)", str(caught.value)))
    assert sorted(evidence) == ["spad512s", "swissspad2-full", "swissspad2-half"]
    assert min(evidence, key=lambda name: float(evidence[name])) == "spad512s"
    path.write_bytes(raw_planes.spad512s(waves) + b"\0\0\0\0")
    assert detection.detect(path) == "spad512s"
    path.rename(tmp_path / "acq_000.bin")
    assert detection.detect(tmp_path / "acq_000.bin") == "spad512s"


@pytest.mark.parametrize("top", [1, 3, 7, 15, 127])
def test_counts_that_look_like_a_cube_are_asked_about(tmp_path: Path, top: int):
    array = np.zeros((3, 5, 7), np.uint8)
    array[1, 2, 3] = top
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(ValueError, match=rf"uint8 up to {top}: codes of .* choose with --layout codes"):
        importing.read(tmp_path / "a.npy")


def test_detection_by_name_signature_and_type(tmp_path: Path):
    np.save(tmp_path / "cube.npy", np.full((2, 3, 4), 200, np.uint8))
    np.save(tmp_path / "light.npy", np.full((2, 3, 4), 0.5, np.float32))
    np.save(tmp_path / "counts.npy", np.full((2, 3, 4), 5, np.uint16))
    np.save(tmp_path / "planes.npy", np.ones((2, 3, 4), bool))
    kinds = {"cube": "cube", "light": "light", "counts": "light", "planes": "codes"}
    assert {name: detection.detect(tmp_path / f"{name}.npy") for name in kinds} == kinds
    (tmp_path / "x.xyz").touch()
    with pytest.raises(ValueError, match="unknown kind of file; say which with --layout: cube, "):
        importing.read(tmp_path / "x.xyz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        importing.read(tmp_path / "none.npy")
    (tmp_path / "empty").mkdir()
    (tmp_path / "visionsim").mkdir()
    (tmp_path / "visionsim" / "transforms.db").touch()
    with pytest.raises(ValueError, match=r"let visionsim write a transforms\.json"):
        importing.read(tmp_path / "visionsim")
    with pytest.raises(ValueError, match="a folder of no known kind"):
        importing.read(tmp_path / "empty")


def test_captures_without_sense():
    with pytest.raises(ValueError, match="frame rate: expected frames per second above 0"):
        Import(0)
    with pytest.raises(ValueError, match=r"at most a frame's 0\.001 s"):
        Import(1000, exposure=2e-3)


def test_wrong_kinds_are_refused_with_advice(tmp_path: Path):
    np.save(tmp_path / "planes.npy", np.ones((2, 3, 4), bool))
    np.save(tmp_path / "light.npy", np.ones((2, 3, 4), np.float32))
    codes, light = importing.read(tmp_path / "planes.npy"), importing.read(tmp_path / "light.npy")
    with pytest.raises(ValueError, match="holds codes, not light"):
        importing.to_clip(codes, tmp_path / "c", CAPTURE)
    with pytest.raises(ValueError, match="holds light, not codes"):
        importing.to_stream(light, tmp_path / "s", CAPTURE)
    stream = importing.to_stream(codes, tmp_path / "s", CAPTURE)
    clip = importing.to_clip(light, tmp_path / "c", CAPTURE)
    np.save(tmp_path / "deep.npy", np.full((2, 3, 4), 1000, np.uint16))
    deep = importing.to_stream(importing.read(tmp_path / "deep.npy", Hints("codes", bits=10)), tmp_path / "d", CAPTURE)
    for source, kind, message in [
        (clip, "cube", "a clip holds light"),
        (stream, "exr", "EXR holds light"),
        (deep, "mp4", "a video holds 8 bits per pixel, this stream has 10"),
    ]:
        with pytest.raises(ValueError, match=message):
            exporting.export(source, tmp_path / "out", Export(kind))
        assert not (tmp_path / "out").exists()
    with pytest.raises(FileExistsError, match="--force"):
        importing.to_stream(codes, tmp_path / "s", CAPTURE)


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


def test_a_stream_is_named_by_its_codes_too(tmp_path: Path):
    """`convert STREAM.npy` is `convert STREAM.json`: our own codes are nothing foreign that needs a frame rate."""
    np.save(tmp_path / "p.npy", random_planes(4, 6, 16).astype(bool))
    stream = importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "mine", CAPTURE)
    for suffix in (".npy", ".json"):
        assert main(["convert", str(stream.path.with_suffix(suffix)), str(tmp_path / f"from{suffix}.npy")]) == 0
    assert (tmp_path / "from.npy.npy").read_bytes() == (tmp_path / "from.json.npy").read_bytes()


@pytest.mark.parametrize("full", [False, True])
def test_our_camera_files_are_read_alike_by_others(tmp_path: Path, full: bool):
    photoncube = pytest.importorskip("photoncube", reason="the package photoncube is not installed")
    frames, height = (256, 512) if full else (512, 256)
    expected = random_planes(frames, height, 512)
    (tmp_path / "raw").mkdir()
    encode = raw_planes.full if full else raw_planes.half
    (tmp_path / "raw" / "filename0.bin").write_bytes(encode(expected))
    photoncube.PhotonCube.convert_to_npy(str(tmp_path / "raw"), str(tmp_path / "theirs.npy"), is_full_array=full)
    np.testing.assert_array_equal(everything(tmp_path / "theirs.npy", layout="cube"), expected)


def test_streams_survive_an_interrupted_conversion(tmp_path: Path):
    np.save(tmp_path / "p.npy", np.ones((4, 6, 16), bool))

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "s", CAPTURE, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.npy"]


def test_opening_an_unfinished_stream(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no such stream"):
        Stream.open(tmp_path / "s.json")
    (tmp_path / "s.json").write_text('{"format_version": 1}')
    with pytest.raises(ValueError, match="key 'shape' is missing"):
        Stream.open(tmp_path / "s.json")


SATURATING = {  # kind -> (largest value of the file's pixels, colour)
    "png8": (255, False), "png16": (65535, False), "colour": (255, True), "tiff": (65535, False),
    "npy": (65535, False), "mp4": (255, False), "floats": (None, False),
}  # fmt: skip


@pytest.mark.parametrize("kind", SATURATING)
@pytest.mark.parametrize("white", [None, 40, 200])
def test_saturated_pixels_are_counted_marked_and_reported(
    tmp_path: Path, kind: str, white: int | None, capsys: pytest.CaptureFixture[str]
):
    """Every pixel at or above white, of every reader of light, flips included; without --white the full scale is it."""
    import tifffile
    from PIL import Image

    full, colour = SATURATING[kind]
    rng = np.random.default_rng(len(kind))
    values = rng.integers(0, 256, (3, 8, 10))
    values[1] = np.minimum(values[1], 39)  # one frame without any
    values[2, 0, 0] = 255
    shown = np.where(values == 255, full, values) if full else values / 255
    source, mask = tmp_path / "in", values >= (white or 255)
    source.mkdir()
    if kind in ("png8", "png16", "colour"):
        for t, image in enumerate(shown.astype(np.uint16 if kind == "png16" else np.uint8)):
            # one channel only has the value: any of them saturates the pixel
            picture = np.stack([image // 2, image, np.zeros_like(image)], axis=-1) if colour else image
            Image.fromarray(picture).save(source / f"{t}.png")
    elif kind == "tiff":
        source = source / "a.tif"
        tifffile.imwrite(source, shown.astype(np.uint16), photometric="minisblack")
    elif kind == "mp4":
        source = source / "a.mp4"
        video.write_video(source, iter(shown.astype(np.uint8)), 30, lossless=True)
    else:
        source = source / "a.npy"
        np.save(source, shown.astype(np.float32 if kind == "floats" else np.uint16))
    level = [] if white is None else ["--white", str(white / 255 if kind == "floats" else white)]
    line = ["convert", str(source), str(tmp_path / "clip"), "--frame-rate", "1000", "--transfer", "linear",
            "--layout", {"tiff": "tiff", "mp4": "video"}.get(kind, "png" if source.is_dir() else "light"),
            "--flip", "lr", *level]  # fmt: skip
    assert main(line) == 0
    said = capsys.readouterr().out
    assert "3 frames of 8 x 10 pixels at 1000 per second, exposure 1000 us" in said
    clip = Clip.open(tmp_path / "clip")
    if kind == "floats" and white is None:
        assert "saturation not known" in said
        mask = np.zeros_like(mask)
    else:
        assert f"white {white / 255 if kind == 'floats' else white:g}: " in said if white else "assumed: " in said
        assert f"{100 * mask.mean():.3g} % of pixels saturated" in said
    found = np.stack([clip.saturated(t) for t in range(3)])
    np.testing.assert_array_equal(found, mask[..., ::-1])
    np.testing.assert_array_equal(clip.saturated(2, (1, 2, 4, 5)), found[2, 1:5, 2:7])
    assert clip.meta["saturated_pixels"] == clip.meta["clipped_pixels"] == mask.sum()
    assert clip.meta["saturation"]["assumed"] == (white is None)
    assert sorted(path.name for path in (clip.path).glob("saturated/*")) == [
        f"{t:06d}.exr" for t in range(3) if mask[t].any()
    ]
    assert clip.verify() == []
    assert not clip.has_truth


def test_a_white_that_cannot_act_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "codes.npy", np.zeros((2, 6, 8), np.uint8))
    np.save(tmp_path / "light.npy", np.zeros((2, 6, 8), np.uint16))
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    for line, words in [
        (
            ["codes.npy", "o", "--layout", "codes", "--bits", "3", "--frame-rate", "9"],
            "--white changes nothing for codes",
        ),
        (["light.npy", "o", "--transfer", "linear", "--frame-rate", "9"], "pixels hold values up to 65535"),
        ([str(clip.path), "o", "--to", "exr"], "light written as mp4 or png"),
    ]:
        assert main(["convert", str(tmp_path / line[0]), str(tmp_path / "o"), *line[2:], "--white", "70000"]) == 2
        assert words in capsys.readouterr().err
        assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("suffix", [".npy", ".mp4", ".zarr"])
def test_light_is_not_read_into_a_folder_that_is_named_like_a_file(tmp_path: Path, capsys, suffix: str):
    np.save(tmp_path / "light.npy", np.zeros((2, 6, 8), np.uint16))
    words = ["convert", str(tmp_path / "light.npy"), str(tmp_path / f"o{suffix}"), "--transfer", "linear"]
    assert main([*words, "--frame-rate", "9"]) == 2
    assert f"without {suffix}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["light.npy"]


def test_what_was_written_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    for kind, words in [
        ("mp4", "mp4, 2 frames of 6 x 8 pixels at 2000 per second, played at 30, light by gamma 2.2, white"),
        ("exr", "exr, 2 frames of 6 x 8 pixels at 2000 per second, linear light in W m^-2 sr^-1"),
    ]:
        assert main(["convert", str(clip.path), str(tmp_path / kind), "--to", kind]) == 0
        assert f"{tmp_path / kind}: {words}" in capsys.readouterr().out
