"""Tests raw frames of any stated layout against an encoder of whole numbers, and Photron's description."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import CAPTURE, everything

from qsim.calibration.sensor_file import read_stack
from qsim.cli import main
from qsim.formats import importing
from qsim.formats.recording import Hints


def stream_of_bits(pixels: list[int], bits: int, order: str) -> bytes:
    """One large whole number holds all pixels; the rest of the last byte is 1, so that a reader of it would err."""
    total = bits * len(pixels)
    size = -(-total // 8)
    number = 0
    for k, pixel in enumerate(pixels):
        number |= pixel << (bits * k if order == "lsb" else 8 * size - bits * (k + 1))
    rest = (1 << (8 * size - total)) - 1
    number |= rest << total if order == "lsb" else rest
    return number.to_bytes(size, "little" if order == "lsb" else "big")


def raw_bytes(frames: np.ndarray, kind: str, bits: int, first: str, skip: int, padding: int | None) -> bytes:
    found = bytes(range(skip))
    for frame in frames.tolist():
        for row in [[pixel for line in frame for pixel in line]] if padding is None else frame:
            if kind == "packed":
                found += stream_of_bits(row, bits, first)
            else:
                found += b"".join(pixel.to_bytes(1 if bits <= 8 else 2, first) for pixel in row)
            found += bytes(range(padding or 0))
    return found


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_layout_is_read_as_it_was_written(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject):
    kind = data.draw(st.sampled_from(["packed", "whole"]))
    bits = data.draw(
        st.integers(1 if kind == "packed" else 2, 16).filter(lambda b: kind == "whole" or b not in (8, 16))
    )
    first = data.draw(st.sampled_from(["msb", "lsb"] if kind == "packed" else ["big", "little"]))
    skip = data.draw(st.integers(0, 9))
    padding = data.draw(st.none() | st.integers(0, 3))
    shape = data.draw(st.tuples(*[st.integers(1, 5)] * 2, st.integers(1, 19)))
    frames = np.random.default_rng(data.draw(st.integers(0, 99))).integers(0, 1 << bits, shape)
    path = tmp_path_factory.mktemp("raw") / "a.bin"
    path.write_bytes(raw_bytes(frames, kind, bits, first, skip, padding))
    hints: dict[str, Any] = {"layout": "raw", "height": shape[1], "width": shape[2], "bits": bits}
    hints |= {"skip_bytes": skip or None, "row_padding": padding}
    if bits != 8:
        hints["order" if kind == "packed" else "endian"] = first
    np.testing.assert_array_equal(everything(path, **hints), frames)
    middle = importing.read(path, Hints(**hints)).read(shape[0] // 2, shape[0])
    np.testing.assert_array_equal(middle, frames[shape[0] // 2 :])


def test_packed_pixels_of_genicam_and_gige_vision(tmp_path: Path):
    """Golden bytes: 0x123 and 0xABC of 12 bits, 0x155 and 0x2AA of 10 bits."""
    for layout, content, expected in (
        ("mono12p", [0x23, 0xC1, 0xAB], [0x123, 0xABC]),
        ("mono12packed", [0x12, 0xC3, 0xAB], [0x123, 0xABC]),
        ("mono10p", [0x55, 0xA9, 0x0A, 0x00, 0x00], [0x155, 0x2AA, 0, 0]),
        ("mono10packed", [0x55, 0x21, 0xAA], [0x155, 0x2AA]),
    ):
        (tmp_path / "a.raw").write_bytes(bytes(content))
        found = everything(tmp_path / "a.raw", layout=layout, height=1, width=len(expected))
        assert found.tolist() == [[expected]], layout


def test_what_a_raw_file_does_not_state_must_be_given(tmp_path: Path):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(24))
    size: dict[str, Any] = {"layout": "raw", "height": 4, "width": 4}
    for hints, message in (
        ({"layout": "raw"}, "add height= and width= and bits="),
        (size | {"bits": 1}, "pixels of 1 bits; add order=msb or lsb"),
        (size | {"bits": 12}, "add order=msb or lsb if they are packed, or endian="),
        (size | {"bits": 16}, "add endian=little or endian=big"),
        (
            size | {"bits": 12, "order": "msb", "endian": "big"},
            "order= states packed pixels, endian= pixels of whole bytes",
        ),
        (size | {"bits": 8}, "24 bytes are not a whole number of raw .4 x 4 pixels of 8 bits"),
        (size | {"bits": 8, "skip_bytes": 40}, "24 bytes, fewer than the 40 to skip"),
        ({"layout": "mono12packed", "height": 3, "width": 3}, "holds pixels in pairs, not 3 x 3"),
        ({"layout": "swissspad2-half", "skip_bytes": 4}, "not a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            importing.read(path, Hints(**hints))


def test_raw_light_is_linear_up_to_the_full_scale_of_its_bits(tmp_path: Path):
    frames = np.array([[[0, 1, 2047, 4095]]])
    (tmp_path / "a.raw").write_bytes(raw_bytes(frames, "whole", 12, "little", 0, None))
    hints = Hints("raw", height=1, width=4, bits=12, endian="little", transfer="linear")
    recording = importing.read(tmp_path / "a.raw", hints)
    np.testing.assert_allclose(recording.read(0, 1), frames / 4095, rtol=1e-6)
    assert recording.white == 4095
    assert (
        recording.reading
        == "read as 1 frames of 1 x 4 pixels of 12 bits in two bytes, little endian; rows follow without a gap"
    )


CIHX = """binary before
<cih><fileInfo><date>2026/01/01</date></fileInfo><deviceInfo><deviceName>FASTCAM</deviceName></deviceInfo>
<recordInfo><recordRate>{rate}</recordRate><shutterSpeed>{shutter}</shutterSpeed></recordInfo>
<frameInfo><totalFrame>{frames}</totalFrame></frameInfo>
<imageDataInfo><resolution><width>{width}</width><height>{height}</height></resolution>
<colorInfo><bit>{stored}</bit></colorInfo><effectiveBit><depth>{depth}</depth><side>{side}</side></effectiveBit>
</imageDataInfo><imageFileInfo><fileFormat>MRaw</fileFormat><type>Mono</type></imageFileInfo></cih>
"""
CIH = """#Camera Information Header
Record Rate(fps) : {rate}
Shutter Speed(s) : {shutter}
Total Frame : {frames}
Image Width : {width}
Image Height : {height}
Color Bit : {stored}
EffectiveBit Depth : {depth}
EffectiveBit Side : {side}
File Format : MRaw
END
"""


@pytest.mark.parametrize("text", [CIHX, CIH], ids=["cihx", "cih"])
@pytest.mark.parametrize(
    ("stored", "depth", "side"),
    [(8, 8, "Lower"), (12, 12, "Lower"), (16, 12, "Lower"), (16, 12, "Higher"), (16, 16, "Lower"), (16, 8, "Higher")],
)
def test_photron_recordings(tmp_path: Path, text: str, stored: int, depth: int, side: str):
    frames = np.random.default_rng(0).integers(0, 1 << depth, (3, 4, 6))
    shifted = frames << (stored - depth if side == "Higher" else 0)
    kind, first = ("packed", "msb") if stored == 12 else ("whole", "little")
    content = raw_bytes(shifted, kind, stored, first, 0, None)
    (tmp_path / "a.mraw").write_bytes(content)
    facts = {"rate": 20000, "shutter": "1/50000", "frames": 3, "width": 6, "height": 4}
    facts |= {"stored": stored, "depth": depth, "side": side}
    beside = tmp_path / ("a.cihx" if text is CIHX else "a.cih")
    beside.write_text(text.format(**facts))
    recording = importing.read(tmp_path / "a.mraw", Hints(transfer="linear"))
    np.testing.assert_allclose(recording.read(0, 3), frames / (2**depth - 1), rtol=1e-6)
    assert (recording.frame_rate, recording.exposure) == (20000, 2e-5)
    clip = importing.to_clip(recording, tmp_path / "clip", importing.Import(20000))
    assert clip.exposure == 2e-5
    with pytest.raises(ValueError, match=r"frame_rate=1000: Photron \.mraw state 20000; leave it out"):
        importing.to_clip(recording, tmp_path / "other", importing.Import(1000))
    np.testing.assert_array_equal(everything(beside), frames)
    beside.write_text(text.format(**facts | {"frames": 4}))
    with pytest.raises(ValueError, match=f"3 frames, and {beside.name} states 4"):
        importing.read(tmp_path / "a.mraw")
    beside.unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.cihx is not beside it; copy both files"):
        importing.read(tmp_path / "a.mraw")


def test_convert_and_calibrate_read_the_same_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    frames = np.random.default_rng(1).integers(0, 8, (20, 5, 7))
    path = tmp_path / "dark.raw"
    path.write_bytes(raw_bytes(frames, "packed", 3, "lsb", 16, 1))
    words = [
        "--layout",
        "raw",
        "--height",
        "5",
        "--width",
        "7",
        "--order",
        "lsb",
        "--skip-bytes",
        "16",
        "--row-padding",
        "1",
    ]
    out = tmp_path / "s.npy"
    assert main(["convert", str(path), str(out), "--bits", "3", "--frame-rate", "1000", *words]) == 0
    assert "read as 20 frames of 5 x 7 pixels of 3 bits, packed, lowest bit first" in capsys.readouterr().err
    hints = Hints("raw", 5, 7, order="lsb", skip_bytes=16, row_padding=1)
    found = read_stack(path, bits=3, exposure=1e-3, photons=0.0, hints=hints)
    assert np.array_equal(found.total, frames.sum(axis=0))
    stream = importing.to_stream(importing.read(path, replace(hints, bits=3)), tmp_path / "t", CAPTURE)
    np.testing.assert_array_equal(stream.codes(), frames)
