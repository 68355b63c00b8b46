"""Tests raw files of cameras: golden bytes, round trips, sizes that are not full frames."""

import json
from pathlib import Path

import numpy as np
import pytest
import raw_planes
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import everything, one, random_planes

from qsim.formats import importing, raw_cameras, raw_layout
from qsim.formats.recording import Hints


def test_golden_lsb_first_stream():
    assert list(np.packbits(one((1, 2, 10), (0, 0, 0), (0, 1, 9)).ravel(), bitorder="little")) == [1, 0, 8]
    assert list(raw_planes.half(one((1, 256, 512), (0, 0, 0), (0, 0, 9)))[:2]) == [1, 2]


def test_golden_spike():
    assert list(raw_planes.spike(one((1, 2, 8), (0, 1, 0)))) == [1, 0]


@pytest.mark.parametrize(
    ("y", "x", "byte", "value"),
    [
        (0, 0, 0, 1),
        (0, 127, 15, 0x80),
        (0, 128, 32, 1),
        (255, 0, 32640, 1),
        (256, 0, 32656, 1),
        (511, 0, 16, 1),
        (511, 511, 127, 0x80),
    ],
)
def test_golden_swissspad2_full(tmp_path: Path, y: int, x: int, byte: int, value: int):
    raw = bytearray(32768)
    raw[byte] = value
    (tmp_path / "a.bin").write_bytes(raw)
    expected = one((1, 512, 512), (0, y, x))
    np.testing.assert_array_equal(everything(tmp_path / "a.bin", layout="swissspad2-full"), expected)
    assert raw_planes.full(expected) == bytes(raw)


def test_golden_spad512s():
    assert raw_planes.spad512s(one((1, 512, 512), (0, 0, 0)))[:2] == b"\x80\x00"


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


@settings(max_examples=30, deadline=None)
@given(frames=st.integers(1, 5), height=st.integers(1, 12), width=st.integers(1, 12), seed=st.integers(0, 99))
def test_spikes_are_written_as_others_write_them(
    tmp_path_factory: pytest.TempPathFactory, frames: int, height: int, width: int, seed: int
):
    """The bytes are those of the reference encoder of these tests; frames that fill no whole bytes are refused."""
    path = tmp_path_factory.mktemp("s") / "a.dat"
    planes = random_planes(frames, height, width, seed=seed)
    blocks = [part for part in (planes[:2], planes[2:]) if len(part)]
    if height * width % 8:
        with pytest.raises(ValueError, match=rf"spike frames fill whole bytes, {height} x {width} pixels do not"):
            raw_cameras.write_spike(path, iter(blocks), planes.shape)
        assert not path.exists()
        return
    raw_cameras.write_spike(path, iter(blocks), planes.shape)
    assert path.read_bytes() == raw_planes.spike(planes)
    path.with_name("a.dat.json").write_text(json.dumps({"shape": [frames, height, width]}))
    np.testing.assert_array_equal(everything(path), planes)
    for shape in ([1, 2], [frames, height, "8"], [frames, height * 8, -1], None, [frames, 0, width]):
        path.with_name("a.dat.json").write_text(json.dumps({"shape": shape}))
        with pytest.raises(ValueError, match=r"a\.dat") as caught:
            importing.read(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("layout", "size", "row"),
    [
        ("swissspad2-half", (256, 512), 0),
        ("swissspad2-full", (512, 512), 0),
        ("spad512s", (512, 512), 0),
        ("spike", (6, 8), 5),
    ],
)
def test_the_bit_order_of_raw_files_is_said_as_it_is_read(tmp_path: Path, layout: str, size: tuple[int, int], row: int):
    """The first bit in the said order is the left pixel of the top row, or of the bottom row if it says upside down."""
    raw = np.zeros(size[0] * size[1] // 8, np.uint8)
    hints = Hints(layout, height=size[0], width=size[1]) if layout == "spike" else Hints(layout)
    raw.tofile(tmp_path / "a.raw")
    said = importing.read(tmp_path / "a.raw", hints).source
    assert ("upside down, turned upright" in said.orientation) == (row > 0)
    raw[0] = {"msb": 0x80, "lsb": 0x01}[said.bit_order]
    raw.tofile(tmp_path / "a.raw")
    np.testing.assert_array_equal(importing.read(tmp_path / "a.raw", hints).read(0, 1), one((1, *size), (0, row, 0)))


def test_files_of_equal_numbers_have_one_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It was the order of the file system."""
    found = [tmp_path / folder / "acq_0.bin" for folder in "ba"]
    monkeypatch.setattr(Path, "rglob", lambda self, pattern: iter(found))
    assert raw_layout.raw_files(tmp_path) == found[::-1]


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
