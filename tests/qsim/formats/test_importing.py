"""Tests imports: clips and streams of foreign files, saturation, and refusals."""

from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from recordings import CAPTURE, random_planes

from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.formats import exporting, importing, video
from qsim.formats.exporting import Export
from qsim.formats.importing import Import
from qsim.formats.recording import Hints
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream


def test_the_ball_becomes_a_clip_of_relative_light(tmp_path: Path):
    """A falling ball at 30 000 fps, 12 bits in 16: half precision keeps it to 1 part in 2048."""
    with np.load(Path(__file__).parents[2] / "data" / "ball_12bit.npz") as archive:
        stored = archive["frames"][:3]
    np.save(tmp_path / "ball.npy", stored)
    line = f"convert {tmp_path}/ball.npy {tmp_path}/ball --frame-rate 30000 --exposure 20e-6 --transfer linear"
    assert main(line.split()) == 0
    clip = Clip.open(tmp_path / "ball")
    assert clip.shape == stored.shape
    assert clip.info.radiance_unit == RELATIVE
    assert (clip.frame_rate, clip.exposure) == (30000.0, 20e-6)
    np.testing.assert_allclose(clip.radiance(1), stored[1] / 65535, rtol=2**-11)
    assert main(["sense", str(tmp_path / "ball"), "--bits", "3", "--ppp", "3.25"]) == 0


def test_captures_without_sense():
    with pytest.raises(ValueError, match="frame rate: expected frames per second above 0"):
        Import(0)
    with pytest.raises(ValueError, match=r"at most a frame's 0\.001 s"):
        Import(1000, exposure=2e-3)


def test_wrong_kinds_are_refused_with_advice(tmp_path: Path):
    np.save(tmp_path / "planes.npy", np.ones((2, 3, 4), bool))
    np.save(tmp_path / "light.npy", np.ones((2, 3, 4), np.float32))
    codes = importing.read(tmp_path / "planes.npy")
    light = importing.read(tmp_path / "light.npy")
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
    with pytest.raises(FileExistsError, match="force=True"):
        importing.to_stream(codes, tmp_path / "s", CAPTURE)


def test_a_stream_is_named_by_its_codes_too(tmp_path: Path):
    """`convert STREAM.npy` is `convert STREAM.json`: our own codes are nothing foreign that needs a frame rate."""
    np.save(tmp_path / "p.npy", random_planes(4, 6, 16).astype(bool))
    stream = importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "mine", CAPTURE)
    for suffix in (".npy", ".json"):
        assert main(["convert", str(stream.path.with_suffix(suffix)), str(tmp_path / f"from{suffix}.npy")]) == 0
    assert (tmp_path / "from.npy.npy").read_bytes() == (tmp_path / "from.json.npy").read_bytes()


def test_a_stream_keeps_a_name_with_dots(tmp_path: Path):
    """Names of two light levels are two streams, with and without .npy and .json."""
    np.save(tmp_path / "p.npy", random_planes(4, 6, 16).astype(bool))
    codes = importing.read(tmp_path / "p.npy")
    for given, name in [("spad_4.9ppp", "spad_4.9ppp"), ("spad_4.1ppp.npy", "spad_4.1ppp"), ("s.2.json", "s.2")]:
        stream = importing.to_stream(codes, tmp_path / "out" / given, CAPTURE)
        assert stream.path == tmp_path / "out" / f"{name}.npy"
        assert Stream.open(tmp_path / "out" / f"{name}.json").verify() == []
        with pytest.raises(FileExistsError, match=rf"{name}\.npy: exists"):
            importing.to_stream(codes, tmp_path / "out" / name, CAPTURE)
    assert len(list((tmp_path / "out").iterdir())) == 6


def test_streams_survive_an_interrupted_conversion(tmp_path: Path):
    np.save(tmp_path / "p.npy", np.ones((4, 6, 16), bool))

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        importing.to_stream(importing.read(tmp_path / "p.npy"), tmp_path / "s", CAPTURE, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.npy"]


def test_an_interrupted_import_is_not_finished_with_another_recording(tmp_path: Path, monkeypatch):
    """Of equal settings: every frame, mark and sum is of the second recording, as if there had been no first one."""
    rng = np.random.default_rng(0)
    for name in ("first", "second"):
        np.save(tmp_path / f"{name}.npy", rng.uniform(0, 0.8, (4, 5, 6)).astype(np.float32) + (name == "first"))
    first, second = (importing.read(tmp_path / f"{name}.npy", Hints(white=0.9)) for name in ("first", "second"))
    add = ClipWriter.add
    begun = tmp_path / "clip.part" / "radiance" / "000000.exr"

    def stop(writer: ClipWriter, t: int, *images: np.ndarray, **more: np.ndarray) -> None:
        if t == 2:
            raise KeyboardInterrupt
        add(writer, t, *images, **more)

    with monkeypatch.context() as patch:
        patch.setattr(ClipWriter, "add", stop)
        stored = []
        for _ in range(2):  # the same recording keeps what is stored
            with pytest.raises(KeyboardInterrupt):
                importing.to_clip(first, tmp_path / "clip", CAPTURE)
            stored.append(begun.stat().st_ino)
        assert stored[0] == stored[1]
    clip = importing.to_clip(second, tmp_path / "clip", CAPTURE)
    alone = importing.to_clip(second, tmp_path / "alone" / "clip", CAPTURE)
    found, expected = ({p.name: p.read_bytes() for p in c.path.rglob("*") if p.is_file()} for c in (clip, alone))
    assert found == expected
    assert clip.verify() == []
    assert str(tmp_path) not in (clip.path / "clip.json").read_text()


@pytest.mark.parametrize(("unit", "scale"), [(65535.0, 0.5), (1e9, 2.0**-14), (1e-9, 2.0**29), (1.0, 1.0)])
def test_light_that_halves_cannot_hold_is_scaled(tmp_path: Path, capsys, unit: float, scale: float):
    """16-bit light as floats was cut at 65504; the factor is a power of 2, so nothing else changes."""
    light = (np.random.default_rng(0).uniform(0.1, 1, (2, 5, 8)) * unit).astype(np.float32)
    light[1, 2, 0] = unit
    np.save(tmp_path / "light.npy", light)
    for white, said in [([], "saturation not known"), (["--white", str(unit)], f"white {unit:g}: 1.25 % of pixels")]:
        line = ["convert", str(tmp_path / "light.npy"), str(tmp_path / "clip"), "--frame-rate", "1000", "--force"]
        assert main([*line, *white]) == 0
        out = capsys.readouterr().out
        assert said in out
        assert (f"the light of the file is scaled by {scale:g}" in out) == (scale != 1)
        clip = Clip.open(tmp_path / "clip")
        assert (clip.info.source.scale or 1.0) == scale
        np.testing.assert_allclose([clip.radiance(t) for t in range(2)], light * scale, rtol=2.0**-11)
        assert clip.info.saturated_pixels == len(white) // 2


def test_deep_pictures_are_not_cut(tmp_path: Path, capsys):
    np.save(tmp_path / "deep.npy", np.full((2, 5, 8), 65530, np.uint16))
    line = ["convert", str(tmp_path / "deep.npy"), str(tmp_path / "deep"), "--frame-rate", "9", "--transfer", "linear"]
    assert main([*line, "--white", "65520"]) == 0
    assert "cut off" not in capsys.readouterr().out


def test_codes_of_a_named_sensor_have_its_law(tmp_path: Path):
    """Counts of a QIS or a counting SPAD are no sums of planes; those of a clocked SPAD are."""
    np.save(tmp_path / "codes.npy", np.random.default_rng(0).integers(0, 8, (2, 5, 6)).astype(np.uint8))
    recording = importing.read(tmp_path / "codes.npy", Hints(bits=3))
    for name, ppp, model, planes in [
        (None, None, "binary_sum", 7),
        ("spad-320x240", None, "binary_sum", 7),
        ("quiver-physical", 3.25, "multibit", 1),
    ]:
        stream = importing.to_stream(recording, tmp_path / str(name), Import(1000.0, sensor=name, ppp=ppp))
        assert (stream.info.code_model, stream.info.planes_per_code) == (model, planes)
        assert stream.sensor.code_model == model


def test_opening_an_unfinished_stream(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no such stream"):
        Stream.open(tmp_path / "s.json")
    (tmp_path / "s.json").write_text('{"format_version": 1}')
    with pytest.raises(ValueError, match="key 'shape' is missing"):
        Stream.open(tmp_path / "s.json")


SATURATING = {  # kind -> (largest value of the file's pixels, colour)
    "png8": (255, False),
    "png16": (65535, False),
    "colour": (255, True),
    "tiff": (65535, False),
    "npy": (65535, False),
    "mp4": (255, False),
    "floats": (None, False),
}


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
    source = tmp_path / "in"
    mask = values >= (white or 255)
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
    shown_white = white
    if white is not None and kind == "floats":
        shown_white = white / 255
    level = [] if white is None else ["--white", str(shown_white)]
    line = [
        "convert",
        str(source),
        str(tmp_path / "clip"),
        "--frame-rate",
        "1000",
        "--transfer",
        "linear",
        "--layout",
        {"tiff": "tiff", "mp4": "video"}.get(kind, "png" if source.is_dir() else "light"),
        "--flip",
        "lr",
        *level,
    ]
    assert main(line) == 0
    said = capsys.readouterr().out
    assert "3 frames of 8 x 10 pixels at 1000 per second, exposure 1000 us" in said
    clip = Clip.open(tmp_path / "clip")
    if kind == "floats" and white is None:
        assert "saturation not known" in said
        mask = np.zeros_like(mask)
    else:
        assert (f"white {shown_white:g}: " if white else "assumed: ") in said
        assert f"{100 * mask.mean():.3g} % of pixels saturated" in said
    found = np.stack([clip.saturated(t) for t in range(3)])
    np.testing.assert_array_equal(found, mask[..., ::-1])
    np.testing.assert_array_equal(clip.saturated(2, (1, 2, 4, 5)), found[2, 1:5, 2:7])
    assert clip.info.saturated_pixels == clip.info.clipped_pixels == mask.sum()
    assert clip.info.saturation.assumed == (white is None)
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
        ([str(clip.path), "o", "--to", "exr"], "--white: changes nothing in "),
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


def test_a_stream_states_the_defects_and_the_filters_of_its_sensor(tmp_path: Path):
    """As streams that `qsim sense` draws: tables of the file, and the mean dark rate of the measured map."""
    np.save(tmp_path / "p.npy", random_planes(4, 6, 16).astype(bool))
    np.save(tmp_path / "rates.npy", np.full((6, 16), 80.0))
    sensor = '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 20.0\nbits = 1\n'
    (tmp_path / "plain.toml").write_text(sensor)
    (tmp_path / "my.toml").write_text(f'{sensor}[defects]\ndark_map = "rates.npy"\n[colour]\nmask = "quad"\n')
    codes = importing.read(tmp_path / "p.npy")
    plain, mine = (
        importing.to_stream(codes, tmp_path / name, Import(1000, sensor=str(tmp_path / f"{name}.toml")))
        for name in ("plain", "my")
    )
    assert (plain.info.defects, plain.info.colour) == ({}, None)
    assert plain.sensor.dark_rate == 20.0
    assert mine.colour_filter == ColourFilter(MASKS["quad"])
    assert list(mine.info.defects) == ["dark_map"]
    assert mine.sensor.dark_rate == 80.0
    np.testing.assert_array_equal(mine.codes(0, 4), plain.codes(0, 4))


def test_a_light_level_that_sets_no_gain_is_refused(tmp_path: Path):
    """It left no trace."""
    np.save(tmp_path / "codes.npy", np.random.default_rng(0).integers(0, 8, (2, 5, 6)).astype(np.uint8))
    recording = importing.read(tmp_path / "codes.npy", Hints(bits=3))
    for name in ("spad-320x240", "quiver-paper"):
        with pytest.raises(ValueError, match=f"ppp= changes nothing for {name}, whose gain is fixed; leave it out"):
            importing.to_stream(recording, tmp_path / "s", Import(1000.0, sensor=name, ppp=5.0))
