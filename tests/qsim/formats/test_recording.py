"""Tests recordings: order of files, flips, stated bit order and orientation."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import raw_planes
from recordings import CAPTURE, everything, random_planes
from sdt_files import sdt_bytes

from qsim.clip.source import Source
from qsim.file_order import numbered
from qsim.formats import array_files, detection, exporting, images, importing, photon_times, video
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints, Recording
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense


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
    assert [p.name for p in numbered([Path("a10.png"), Path("a9.png"), Path("._a2.png"), Path("a1.png")])] == [
        "a1.png",
        "a9.png",
        "a10.png",
    ]


@pytest.mark.parametrize(
    "names",
    [
        [f"img_{n}_200us" for n in range(1, 13)],
        [f"{ms // 1000}.{ms % 1000:03}" for ms in range(995, 1006)],
        ["12-30-58", "12-30-59", "12-31-00", "12-31-01"],
        [f"take{take}_{n}" for take in (1, 2) for n in range(9, 12)],
        # right before, too: a constant number, a hash (one frame left out) or an exposure before the counter
        [f"cam2_{n}" for n in range(8, 12)],
        ["3fa9c1_1", "77bc_2", "0c7d1_4", "e5_11"],
        [f"img_{400 if n % 2 else 100}us_{n}" for n in range(1, 13)],
        # decimals are numbers, of any length; whole numbers after an equal one (VFX) still count
        ["RAW_0.125", "RAW_0.25", "RAW_0.5", "RAW_1.0"],
        [f"{n / 10:g}.0" if n == 10 else f"{n / 10:g}" for n in range(1, 13)],
        ["1726830927.5", "1726830927.75", "1726830928.125", "1726830928.2", "1726830928.25"],
        [f"shot1.{n}" for n in range(8, 12)],
        [f"{0.0625 * n:g}s" for n in range(1, 12)],
        ["t_0,125", "t_0,25", "t_0,5", "t_1,0"],
        ["1e-3s", "2e-3s", "1e-2s", "2.5e-1s", "1e+1s"],
        # a hyphen is a sign where other names have none, and a hyphen where all have it
        ["z-10", "z-1.5", "z-0.5", "z0.5", "z2"],
        ["-2", "-1", "0", "1"],
        ["z-1", "z-2", "z-10"],
        # days without a gap in three months
        ["2026-01-02", "2026-01-03", "2026-02-01"],
        ["77-310e-42d4_1", "77-310e-41d4_2", "77-9e-41d4_3"],
    ],
    ids=lambda names: names[0],
)
def test_the_numbers_of_a_name_decide_its_place(names: list[str]):
    shuffled = np.random.default_rng(0).permutation(names)
    assert [path.stem for path in numbered([Path(f"{name}.png") for name in shuffled])] == names


def test_flips(tmp_path: Path):
    expected = random_planes(2, 512, 512)
    (tmp_path / "acq_0.bin").write_bytes(raw_planes.spad512s(expected))
    np.testing.assert_array_equal(everything(tmp_path / "acq_0.bin", flip="lr"), expected[..., ::-1])
    np.testing.assert_array_equal(everything(tmp_path / "acq_0.bin", flip="ud"), expected[:, ::-1])


def _cube(folder: Path, planes_: np.ndarray) -> Path:
    np.save(folder / "a.npy", np.packbits(planes_, axis=2))
    return folder / "a.npy"


def _codes(folder: Path, planes_: np.ndarray) -> Path:
    np.save(folder / "a.npy", planes_.astype(bool))
    return folder / "a.npy"


def _light(folder: Path, planes_: np.ndarray) -> Path:
    np.save(folder / "a.npy", planes_.astype(np.float32))
    return folder / "a.npy"


def _video(folder: Path, planes_: np.ndarray) -> Path:
    pytest.importorskip("av")
    video.write_video(folder / "a.mp4", iter(255 * planes_), 30, lossless=True)
    return folder / "a.mp4"


def _png(folder: Path, planes_: np.ndarray) -> Path:
    images.write_png(folder, iter(planes_.astype(bool)))
    return folder


def _tiff(folder: Path, planes_: np.ndarray) -> Path:
    pytest.importorskip("tifffile").imwrite(folder / "a.tif", planes_[0].astype(bool))
    return folder / "a.tif"


def _visionsim(folder: Path, planes_: np.ndarray) -> Path:
    np.save(folder / "frames.npy", np.packbits(planes_[..., None], axis=2))
    (folder / "transforms.json").write_text('{"w": 16, "h": 16, "c": 1, "bitpack": true, "bitpack_dim": 2}')
    return folder


def _zarr(folder: Path, planes_: np.ndarray) -> Path:
    pytest.importorskip("zarr")
    array_files.write_zarr(folder / "a.zarr", iter([planes_]), (2, 16, 16), {})
    return folder / "a.zarr"


def _mat(folder: Path, planes_: np.ndarray) -> Path:
    from scipy.io import savemat

    savemat(folder / "a.mat", {"OUTPUT": planes_.transpose(1, 2, 0)})
    return folder / "a.mat"


def _photons(folder: Path, planes_: np.ndarray) -> Path:
    """One photon for each pixel."""
    meta = {"format": photon_times.FORMAT, "shape": [2, 16, 16], "exposure": 1e-3, "frame_rate": 1e3}
    first = np.arange(257)
    kind = np.ones(256, np.uint8)
    text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    np.savez(folder / "a.npz", times=np.linspace(0, 1.9e-3, 256), kind=kind, first=first, meta=text)
    return folder / "a.npz"


def _hdf5(folder: Path, planes_: np.ndarray) -> Path:
    with pytest.importorskip("h5py").File(folder / "a.h5", "w") as file:
        file["entry/data"] = planes_.astype(bool)
    return folder / "a.h5"


def _ptu(folder: Path, planes_: np.ndarray) -> Path:
    pytest.importorskip("ptufile").imwrite(folder / "a.ptu", np.ones((2, 4, 4, 1, 4), np.uint16), 1e-7, 1e-8)
    return folder / "a.ptu"


def _sdt(folder: Path, planes_: np.ndarray) -> Path:
    pytest.importorskip("sdtfile")
    (folder / "a.sdt").write_bytes(sdt_bytes(np.ones((1, 4, 4, 4))))
    return folder / "a.sdt"


def _mraw(folder: Path, planes_: np.ndarray) -> Path:
    (folder / "a.mraw").write_bytes(bytes(2 * 16 * 16))
    names = ("Record Rate(fps) : 1000", "Shutter Speed(s) : 1/1000", "Total Frame : 2", "Image Width : 16")
    names += ("Image Height : 16", "Color Bit : 8", "EffectiveBit Depth : 8", "EffectiveBit Side : Lower")
    (folder / "a.cih").write_text("\n".join((*names, "File Format : MRaw")))
    return folder / "a.mraw"


WRITERS = {
    "cube": _cube,
    "codes": _codes,
    "light": _light,
    "video": _video,
    "png": _png,
    "tiff": _tiff,
    "visionsim": _visionsim,
    "zarr": _zarr,
    "mat": _mat,
    "photons": _photons,
    "hdf5": _hdf5,
    "ptu": _ptu,
    "sdt": _sdt,
    "mraw": _mraw,
}


def sample(folder: Path, layout: str) -> tuple[Path, Hints]:
    """A small recording of each layout, and what has to be said to read it."""
    if layout in WRITERS:
        path = WRITERS[layout](folder, random_planes(2, 16, 16))
    else:  # bare bytes of some planes
        path = folder / "a.bin"
        path.write_bytes(bytes({"spike": 64, "mono10p": 640}.get(layout, 768 if layout.startswith("mono") else 32768)))
    size = {"height": 16, "width": 16}
    needed: dict[str, Any] = {"spike": size, "cube": {"width": 16}, "visionsim": {}, "raw": size | {"bits": 8}}
    needed |= dict.fromkeys(("mono10p", "mono12p", "mono10packed", "mono12packed"), size)
    light = layout in ("light", "video")  # the pictures hold one bit
    return path, Hints(layout, **({"transfer": "linear"} if light else needed.get(layout, {})))


ORDERS = {"highest": "msb", "lowest": "lsb"}


def promised() -> dict[str, tuple[str, str]]:
    """(bit order, orientation) of every layout, in the words of the readers, from the table in docs/files.md."""
    text = (Path(__file__).parents[3] / "docs" / "files.md").read_text(encoding="utf-8")
    found = {}
    for names, _, bits, rows in re.findall(r"^\| (`.*?) \| (.*?) \| ?(.*?) \| (.*?) \|$", text, re.MULTILINE):
        order = next((order for word, order in ORDERS.items() if word in bits), "none")
        for name in re.findall(r"`([\w-]+)`", names):
            found[name] = order, rows.removesuffix(", rows padded").removesuffix(": `--flip lr`")
    return found


@pytest.mark.parametrize("layout", detection.LAYOUTS)
def test_every_reader_says_bit_order_and_orientation(tmp_path: Path, layout: str):
    """As promised in docs/files.md, in what is read and in what is made of it."""
    (tmp_path / "in").mkdir()
    recording = importing.read(*sample(tmp_path / "in", layout))
    make = importing.to_clip if recording.is_light else importing.to_stream
    made = make(recording, tmp_path / "made", replace(CAPTURE, frame_rate=recording.frame_rate or 1000.0))
    order, rows = promised()[layout]
    assert recording.source.bit_order.startswith(order)
    assert recording.source.orientation.startswith(rows)
    said = {key: getattr(recording.source, key) for key in ("bit_order", "orientation")}
    assert (made.info.source, made.info.orientation) == (recording.source, said["orientation"])
    exported = exporting.export(made, tmp_path / "out", Export("png"))
    assert json.loads((exported / "meta.json").read_text())["orientation"] == said["orientation"]


def test_a_disputed_side_stays_disputed_and_a_flip_is_remembered(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(bytes(32768))
    disputed = "as stored, left and right are disputed"
    for flip, said in [("none", disputed), ("lr", f"{disputed}; then flip=lr")]:
        stream = importing.to_stream(
            importing.read(tmp_path / "a.bin", Hints("spad512s", flip=flip)), tmp_path / flip, CAPTURE
        )
        assert stream.info.orientation == stream.info.source.orientation == said
        cube = exporting.export(stream, tmp_path / f"{flip}_cube.npy", Export("cube"))
        assert json.loads(cube.with_name(cube.name + ".json").read_text())["orientation"] == said
    np.save(tmp_path / "light.npy", np.ones((2, 3, 4), np.float32))
    clip = importing.to_clip(importing.read(tmp_path / "light.npy", Hints(flip="ud")), tmp_path / "clip", CAPTURE)
    assert clip.info.source.orientation == "upright; then flip=ud"
    sensed, _ = sense(clip, Sensing("quiver-physical", ppp=3.25))
    assert sensed.info.orientation == "upright; then flip=ud"


def test_a_recording_of_unknown_orientation_is_not_called_upright(tmp_path: Path):
    recording = Recording(
        (1, 2, 8), lambda start, stop: random_planes(stop - start, 2, 8), Source(format="somewhere"), 1
    )
    assert importing.to_stream(recording, tmp_path / "s", CAPTURE).info.orientation == "unknown"
