"""Tests video: lossless grey is exact, and colour follows the standard in its file."""

import json
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from recordings import CAPTURE, clip_of, everything

from qsim.cli.program import main
from qsim.colour import code_levels, from_linear, to_linear
from qsim.colour import luminance as linear_luminance
from qsim.formats import exporting, importing
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints
from qsim.formats.video import read_frames, write_video
from qsim.streams.clip import Clip


def test_lossless_video_is_bit_exact_and_ordinary_video_is_not(tmp_path: Path):
    """A noisy 8-bit clip through our writer and back; the lossy default must differ, or the test tests nothing."""
    pytest.importorskip("av")
    codes = np.random.default_rng(0).integers(0, 8, (6, 34, 46)).astype(np.uint8)
    np.save(tmp_path / "c.npy", codes)
    stream = importing.to_stream(importing.read(tmp_path / "c.npy", Hints("codes", bits=3)), tmp_path / "s", CAPTURE)
    exact = exporting.export(stream, tmp_path / "exact.mp4", Export("mp4"))
    found = everything(exact, transfer="linear") * 255
    np.testing.assert_array_equal(np.rint(found), code_levels(codes, 7))
    lossy = exporting.export(stream, tmp_path / "lossy.mp4", Export("mp4", lossless=False))
    difference = np.rint(everything(lossy, transfer="linear") * 255) - code_levels(codes, 7)
    assert np.abs(difference).max() > 8
    assert json.loads((tmp_path / "exact.mp4.json").read_text())["frame_rate"] == 1000.0


def turned(content: bytes, matrix: tuple[int, int, int, int]) -> bytes:
    """Return the bytes of an mp4 with another display matrix in the header of its track (tkhd of version 0)."""
    a, b, c, d = (65536 * part for part in matrix)
    start = content.index(b"tkhd") + 44
    return content[:start] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + content[start + 36 :]


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_video_is_shown_as_its_display_matrix_says(tmp_path: Path, capsys, quarter: int, mirrored: bool):
    """A phone held upright stores its picture on the side; stored (x, y) is shown at (a x + c y, b x + d y)."""
    pytest.importorskip("av")
    pytest.importorskip("cv2")
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    sign = -1 if mirrored else 1
    matrix = (sign * cos, sign * sin, -sin, cos)
    stored = np.random.default_rng(1).integers(0, 256, (3, 16, 24), dtype=np.uint8)
    write_video(tmp_path / "s.mp4", iter(stored), 30, lossless=True)
    (tmp_path / "t.mp4").write_bytes(turned((tmp_path / "s.mp4").read_bytes(), matrix))
    y, x = np.indices((16, 24))
    right = matrix[0] * x + matrix[2] * y
    down = matrix[1] * x + matrix[3] * y
    expected = np.empty((3, np.ptp(down) + 1, np.ptp(right) + 1), np.uint8)
    expected[:, down - down.min(), right - right.min()] = stored
    np.testing.assert_array_equal(np.rint(everything(tmp_path / "t.mp4", transfer="linear") * 255), expected)
    assert main(f"convert {tmp_path}/t.mp4 {tmp_path}/c --rate 60 --frame-rate 30 --transfer linear".split()) == 0
    assert Clip.open(tmp_path / "c").shape[1:] == expected.shape[1:]
    assert ("turned as its display matrix states" in "".join(capsys.readouterr())) == (matrix != (1, 0, 0, 1))


def test_odd_sizes_of_video(tmp_path: Path):
    pytest.importorskip("av")
    frames = np.random.default_rng(0).random((3, 17, 23)).astype(np.float16).astype(np.float32)
    clip = clip_of(tmp_path / "c", frames)
    path = exporting.export(clip, tmp_path / "c.mp4", Export("mp4", white=1.0))
    np.testing.assert_array_equal(
        np.rint(everything(path, transfer="linear") * 255), from_linear(frames, "gamma 2.2", 255)
    )
    with pytest.raises(ValueError, match=r"lossy H\.264 needs even sizes, .*; leave lossy=True out$"):
        exporting.export(clip, tmp_path / "l.mp4", Export("mp4", lossless=False))
    assert not (tmp_path / "l.mp4").exists()


@pytest.mark.parametrize("kind", ["gray10le", "gray12le", "gray16le", "gbrp12le", "rgb48le"])
def test_video_keeps_more_than_eight_bits(tmp_path: Path, kind: str):
    """All bits of grey and of colour; white is the largest value of the pixels. Eight-bit readers refuse it."""
    pytest.importorskip("av")
    full = 65535 if kind == "rgb48le" else 2 ** int(kind[4:6]) - 1
    rng = np.random.default_rng(0)
    stored = rng.integers(0, full, (3, 16, 24) if kind.startswith("gray") else (3, 16, 24, 3)).astype(np.uint16)
    stored[1, 2, 3] = full
    write_deep_video(tmp_path / "a.mkv", stored, kind)
    recording = importing.read(tmp_path / "a.mkv", Hints(transfer="linear"))
    light = to_linear(stored, "linear", full)
    found, mask = recording.marked(0, 3)
    expected = light if light.ndim == 3 else linear_luminance(light)
    np.testing.assert_allclose(found, expected, atol=2e-5 if kind == "gbrp12le" else 1e-6)  # a step of 16 bits
    white = full if light.ndim == 3 else 65535
    assert (recording.white, np.argwhere(mask).tolist()) == (white, [[1, 2, 3]])
    with pytest.raises(ValueError, match=r"a\.mkv: pixels of more than 8 bits"):
        next(read_frames(tmp_path / "a.mkv"))


def test_colour_that_would_lose_bits_is_refused(tmp_path: Path):
    """FFmpeg makes 16-bit colour of luma and chroma, but its white is 65283, 65472 or another number."""
    pytest.importorskip("av")
    write_deep_video(tmp_path / "a.mkv", np.full((1, 24, 96), 512, np.uint16), "yuv420p10le", height=16)
    with pytest.raises(ValueError, match=r"a\.mkv: colour of 10 bits \(yuv420p10le\) would lose the lower ones; store"):
        importing.read(tmp_path / "a.mkv", Hints(transfer="linear"))


def write_deep_video(path: Path, stored: np.ndarray, kind: str, height: int | None = None) -> None:
    """Arrays [T, H, W] or [T, H, W, 3] of more than 8 bits as FFmpeg's `kind` of frames, without loss."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height = height or stored.shape[1]
        stream.width = stored.shape[2]
        stream.codec_context.pix_fmt = kind
        for image in stored:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=kind)))
        container.mux(stream.encode())


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
    """H.264 in 4:2:0 without loss; FFmpeg converts no colours here, because the reader uses it."""
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
    of_red = 2 * (1 - red) * chroma
    of_blue = 2 * (1 - blue) * chroma
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
    assert (clip.shape, clip.info.split, clip.info.source.transfer) == (rgb.shape[:3], "train", transfer)
    inside = np.abs(np.arange(rgb.shape[2]) % 16 - 7.5) < 4
    kept = np.outer(inside[: rgb.shape[1]], inside)
    found = np.stack([clip.radiance(t) for t in range(len(clip))])[:, kept]
    colours = rgb[:, kept].astype(float)
    low, high = (luminance(bound, transfer) for bound in decoded(colours, matrix, full_range))
    low = low * (1 - 2**-11)
    high = high * (1 + 2**-11)
    assert ((low <= found) & (found <= high)).all()
    weighted_first = (colours @ np.array([0.2126, 0.7152, 0.0722]))[..., None].repeat(3, axis=-1)
    other_matrix = from_ycbcr(*to_ycbcr(colours, matrix), "bt601" if matrix == "bt709" else "bt709")
    for wrong in (colours[..., ::-1], weighted_first, other_matrix):
        light = luminance(wrong, transfer)
        assert ((light < low) | (light > high)).any()


def test_a_video_has_the_rates_of_television(tmp_path: Path):
    av = pytest.importorskip("av")
    rate = Fraction(30000, 1001)
    write_video(tmp_path / "a.mp4", iter(np.zeros((3, 16, 16), np.uint8)), float(rate), lossless=True)
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert film.streams.video[0].average_rate == rate
