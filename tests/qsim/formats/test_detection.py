"""Tests layouts: recognised by name, signature and size, never guessed."""

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
import raw_planes
import tifffile
from PIL import Image
from recordings import clip_of, everything

from qsim.cli.program import main
from qsim.colour import to_linear
from qsim.formats import detection, exporting, images, importing, video
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints
from qsim.streams.clip import Clip


def test_three_raw_layouts_of_one_size_are_not_guessed(tmp_path: Path):
    """Evidence is shown (here the right reading is the smoothest), the decision is the user's."""
    bright = 0.3 + 0.25 * np.sin(2 * np.pi * np.arange(512) / 32)
    waves = (np.random.default_rng(0).random((256, 512, 512), np.float32) < bright).astype(np.uint8)
    path = tmp_path / "capture.bin"
    path.write_bytes(raw_planes.spad512s(waves))
    assert path.stat().st_size == 8_388_608
    with pytest.raises(ValueError, match=r"8388608 bytes fit .*; choose one with layout=") as caught:
        importing.read(path)
    evidence = dict(re.findall(r"([\w-]+) \(roughness ([\d.]+)\)", str(caught.value)))
    assert sorted(evidence) == ["spad512s", "swissspad2-full", "swissspad2-half"]
    assert min(evidence, key=lambda name: float(evidence[name])) == "spad512s"
    path.write_bytes(raw_planes.spad512s(waves) + b"\0\0\0\0")
    assert detection.detect(path) == "spad512s"
    path.rename(tmp_path / "acq_000.bin")
    assert detection.detect(tmp_path / "acq_000.bin") == "spad512s"


@pytest.mark.parametrize("top", [1, 3, 5, 7, 15, 100, 127])
def test_counts_that_look_like_a_cube_are_asked_about(tmp_path: Path, top: int):
    array = np.zeros((3, 5, 7), np.uint8)
    array[1, 2, 3] = top
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(ValueError, match=rf"uint8 up to {top}: codes of .* choose with layout=codes"):
        importing.read(tmp_path / "a.npy")


def test_given_hints_decide_what_an_array_holds(tmp_path: Path):
    """Codes, pictures and packed planes of uint8: each hint belongs to one of them."""
    array = np.random.default_rng(0).integers(0, 8, (3, 5, 7)).astype(np.uint8)
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(everything(tmp_path / "a.npy", bits=3), array)
    np.testing.assert_array_equal(everything(tmp_path / "a.npy", transfer="linear"), to_linear(array, "linear", 255))
    np.testing.assert_array_equal(everything(tmp_path / "a.npy", width=50), np.unpackbits(array, axis=2, count=50))
    with pytest.raises(ValueError, match="does not state its transfer curve"):
        everything(tmp_path / "a.npy", white=7)
    np.save(tmp_path / "b.npy", array.astype(np.uint16) * 100)
    np.testing.assert_array_equal(everything(tmp_path / "b.npy", bits=10), array.astype(np.uint16) * 100)
    np.save(tmp_path / "planes.npy", np.random.default_rng(1).integers(0, 256, (3, 5, 7)).astype(np.uint8))
    with pytest.raises(ValueError, match="bits= changes nothing for photon cube"):
        everything(tmp_path / "planes.npy", bits=1)


@pytest.mark.parametrize(
    ("name", "hints", "kind"),
    [
        ("codes.npy", {"bits": 3, "channel": 0}, "axes TYX"),
        ("planes.npy", {"bits": 1}, "codes of bool"),
        ("one.png", {"bits": 3}, "PNG of one bit"),
        ("one.png", {"stretched": True}, "PNG of one bit"),
        ("one.tif", {"slice": 0}, "a TIFF without such an axis"),
    ],
)
def test_a_hint_that_cannot_act_is_refused(tmp_path: Path, name: str, hints: dict[str, object], kind: str):
    codes = np.random.default_rng(0).integers(0, 2, (2, 3, 4)).astype(np.uint8)
    np.save(tmp_path / "codes.npy", codes)
    np.save(tmp_path / "planes.npy", codes.astype(bool))
    Image.fromarray(codes[0].astype(bool)).save(tmp_path / "one.png")
    tifffile.imwrite(tmp_path / "one.tif", codes[0])
    refused = next(reversed(hints))
    with pytest.raises(ValueError, match=f"{refused}= changes nothing for {kind}; leave it out"):
        importing.read(tmp_path / name, Hints(**hints))


def test_pictures_that_look_like_a_cube_are_asked_about(tmp_path: Path):
    """Neighbours in a row agree in pictures; bytes of packed planes differ, also at the edge of a bright square."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :64] / 64
    pictures = 128 + 100 * np.sin(6 * x + 4 * y) + rng.normal(0, 3, (4, 40, 64))
    np.save(tmp_path / "pictures.npy", pictures.astype(np.uint8))
    with pytest.raises(ValueError, match=r"uint8 up to 2\d\d, much alike along rows: pictures or packed"):
        importing.read(tmp_path / "pictures.npy")
    bright = 0.05 + 0.8 * ((x > 0.3) & (y > 0.2))
    np.save(tmp_path / "planes.npy", np.packbits(rng.random((4, 40, 64)) < bright, axis=2))
    assert detection.detect(tmp_path / "planes.npy") == "cube"


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_recordings_of_one_name_are_refused_before_any_is_read(tmp_path: Path, capsys, force: list[str]):
    for name in ("a b", "a_b", "other"):
        (tmp_path / "in" / name).mkdir(parents=True)
        images.write_png(tmp_path / "in" / name, iter(np.zeros((1, 9, 7), np.uint8)))
    options = ["--frame-rate", "1000", "--transfer", "srgb", *force]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), *options]) == 2
    both = f"{tmp_path / 'in' / 'a b'} and {tmp_path / 'in' / 'a_b'}"
    target = tmp_path / "out" / "a_b"
    assert f"{both} would both become {target}; rename one" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_detection_by_name_signature_and_type(tmp_path: Path):
    np.save(tmp_path / "cube.npy", np.full((2, 3, 4), 200, np.uint8))
    np.save(tmp_path / "light.npy", np.full((2, 3, 4), 0.5, np.float32))
    np.save(tmp_path / "counts.npy", np.full((2, 3, 4), 5, np.uint16))
    np.save(tmp_path / "planes.npy", np.ones((2, 3, 4), bool))
    kinds = {"cube": "cube", "light": "light", "counts": "light", "planes": "codes"}
    assert {name: detection.detect(tmp_path / f"{name}.npy") for name in kinds} == kinds
    (tmp_path / "x.xyz").touch()
    with pytest.raises(ValueError, match="unknown kind of file; name its layout=: cube, "):
        importing.read(tmp_path / "x.xyz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        importing.read(tmp_path / "none.npy")
    (tmp_path / "empty").mkdir()
    (tmp_path / "visionsim").mkdir()
    (tmp_path / "visionsim" / "transforms.db").touch()
    with pytest.raises(ValueError, match=r"let visionsim write a transforms\.json"):
        importing.read(tmp_path / "visionsim")
    with pytest.raises(ValueError, match="a folder of unknown kind"):
        importing.read(tmp_path / "empty")


def test_a_folder_of_videos_becomes_clips(tmp_path: Path):
    pytest.importorskip("av")
    frames = np.random.default_rng(0).random((2, 16, 24))
    clip = clip_of(tmp_path / "c", frames)
    for name in ("test_00000.mp4", "occ/a.mp4"):
        exporting.export(clip, tmp_path / "in" / name, Export("mp4", white=1.0))
    options = ["--frame-rate", "2000", "--transfer", "gamma 2.2", "--split", "test"]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), *options]) == 0
    found = Clip.open(tmp_path / "out" / "occ_a")
    assert found.info.split == "test"
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


def test_a_video_among_pictures_is_not_preferred(tmp_path: Path, capsys):
    """The preview of a recording became the clip, and its pictures were dropped."""
    pytest.importorskip("av")
    pictures = np.random.default_rng(0).integers(0, 255, (3, 8, 10)).astype(np.uint8)
    (tmp_path / "in").mkdir()
    images.write_png(tmp_path / "in", iter(pictures))
    video.write_video(tmp_path / "in" / "preview.mp4", iter(pictures), 30, lossless=True)
    command = ["convert", str(tmp_path / "in"), str(tmp_path / "out"), "--frame-rate", "1000", "--transfer", "srgb"]
    assert main(command) == 2
    both = f"holds videos ({tmp_path / 'in' / 'preview.mp4'}) and other recordings ({tmp_path / 'in' / '000000.png'})"
    assert f"{both}; choose with --layout" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*command, "--layout", "png"]) == 0
    assert Clip.open(tmp_path / "out").shape == (3, 8, 10)
    command[2] = str(tmp_path / "videos")
    assert main([*command, "--layout", "video"]) == 0
    assert [path.name for path in (tmp_path / "videos").iterdir()] == ["preview"]


def test_a_gzipped_array_is_asked_about_like_another(tmp_path: Path):
    """Its codes became a stream eight times as wide, made of their bits."""
    codes = np.random.default_rng(0).integers(0, 8, (3, 5, 7)).astype(np.uint8)
    packed = tmp_path / "a.npy.gz"
    for array in (codes, codes > 3):
        np.save(tmp_path / "a.npy", array)
        packed.write_bytes(gzip.compress((tmp_path / "a.npy").read_bytes()))
        if array.dtype == bool:
            np.testing.assert_array_equal(everything(packed), array)
            continue
        with pytest.raises(ValueError, match=r"a\.npy\.gz: uint8 up to 7: codes of 3 bits.* layout=codes"):
            importing.read(packed)
        np.testing.assert_array_equal(everything(packed, bits=3), codes)


@pytest.mark.parametrize("other", ["000000.tif", "acq00000.bin"])
def test_a_preview_beside_a_recording_is_not_taken_for_it(tmp_path: Path, other):
    """One frame, the preview, became the clip."""
    folder = tmp_path / "in"
    folder.mkdir()
    images.write_png(folder, iter(np.zeros((1, 8, 10), np.uint8)))
    (folder / other).write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"holds recordings of two kinds \(.*; choose with layout=$"):
        detection.detect(folder)


@pytest.mark.parametrize("layout", [None, "png"])
def test_a_picture_beside_folders_of_pictures_is_not_taken_for_them(tmp_path: Path, layout):
    for place in (tmp_path, tmp_path / "a", tmp_path / "b"):
        place.mkdir(exist_ok=True)
        images.write_png(place, iter(np.zeros((2, 8, 10), np.uint8)))
    with pytest.raises(ValueError, match=r"holds pictures and folders of pictures \(.*a\); move one of them away$"):
        detection.recordings(tmp_path, layout)


def test_endings_of_tiff_are_read_in_any_case(tmp_path: Path):
    """`.TIF` was refused, and left out beside `.tif`."""
    tifffile = pytest.importorskip("tifffile")
    pictures = np.random.default_rng(0).integers(0, 255, (3, 6, 8)).astype(np.uint8)
    for name, picture in zip(("a_1.tif", "a_2.TIF", "a_3.TIFF"), pictures, strict=True):
        tifffile.imwrite(tmp_path / name, picture)
    np.testing.assert_array_equal(importing.read(tmp_path, Hints(transfer="linear")).shape, (3, 6, 8))


def test_an_array_beside_a_picture_is_not_dropped(tmp_path: Path):
    images.write_png(tmp_path, iter(np.zeros((1, 8, 10), np.uint8)))
    np.save(tmp_path / "capture.npy", np.zeros((2, 8, 2), np.uint8))
    with pytest.raises(ValueError, match=r"holds recordings of two kinds \(.*000000\.png, .*capture\.npy\)"):
        detection.detect(tmp_path)


def test_signed_codes_are_codes(tmp_path: Path):
    """NumPy's default integers were taken for a picture, whose transfer curve then refused bits."""
    codes = np.random.default_rng(0).integers(0, 8, (4, 8, 8))
    np.save(tmp_path / "x.npy", codes)
    np.testing.assert_array_equal(everything(tmp_path / "x.npy", bits=3), codes)
    np.save(tmp_path / "b.npy", codes > 3)
    with pytest.raises(ValueError, match="bool values are codes of one bit, not light"):
        importing.read(tmp_path / "b.npy", Hints(layout="light", transfer="linear"))


def test_missing_shards_and_parts_are_told(tmp_path: Path):
    """Frames before and after them were joined."""
    scene = tmp_path / "scene"
    scene.mkdir()
    planes = np.random.default_rng(0).integers(0, 255, (4, 5, 2, 3)).astype(np.uint8)
    description = {"w": 16, "h": 5, "frames": [{"file_path": str(i)} for i in range(8)]}
    (scene / "transforms.json").write_text(json.dumps(description))
    np.save(scene / "0000.npy", planes)
    with pytest.raises(ValueError, match=r"3 colour planes; choose one with channel=0"):
        importing.read(scene)  # the file states no number of channels
    with pytest.raises(ValueError, match=r"4 frames, and transforms\.json states 8; add the shards that are missing"):
        importing.read(scene, Hints(channel=1))
    np.save(scene / "0001.npy", planes)
    assert importing.read(scene, Hints(channel=1)).shape == (8, 5, 16)
    savemat = pytest.importorskip("scipy.io").savemat
    for number in (1, 3):
        savemat(tmp_path / f"part_{number}.mat", {"OUTPUT": np.ones((5, 6, 2))})
    with pytest.raises(ValueError, match=r"not numbered 1, 2, \.\.\. without a gap: part_1\.mat, part_3\.mat"):
        importing.read(tmp_path, Hints(layout="mat"))


def test_a_cube_of_ours_keeps_its_orientation(tmp_path: Path):
    np.save(tmp_path / "c.npy", np.zeros((3, 4, 2), np.uint8))
    about = {"software": {"qsim": "0"}, "shape": [3, 4, 13], "orientation": "as stored"}
    (tmp_path / "c.npy.json").write_text(json.dumps(about))
    found = importing.read(tmp_path / "c.npy")
    assert (found.shape, found.source.orientation) == ((3, 4, 13), "as stored")


@pytest.mark.parametrize("bits", ["big", "little"])
@pytest.mark.parametrize(("light", "frames"), [(0.02, 3), (0.3, 8), (0.9, 2)])
def test_noise_that_hides_a_layout_is_named(tmp_path, bits, light, frames):
    """1-bit planes of 512 x 512 pixels in either order of bits: never a wrong layout, and never 'near 1' for one."""
    rng = np.random.default_rng(frames)
    scene = light * (1 + 0.5 * np.sin(np.arange(512) / 40) * np.cos(np.arange(512)[:, None] / 30)) / 1.5
    planes = (rng.random((frames, 512, 512)) < scene).astype(np.uint8)
    path = tmp_path / "noisy.bin"
    path.write_bytes(np.packbits(planes, axis=2, bitorder=bits).tobytes())
    with pytest.raises(ValueError, match=r"fit swissspad2-half .*these frames are too noisy or too rough to tell"):
        detection.detect(path)


@pytest.mark.parametrize(("bits", "layout"), [("big", "spad512s"), ("little", "swissspad2-full")])
def test_the_smoothest_layout_is_the_true_one(tmp_path, bits, layout):
    """Fine texture that noise does not hide: only the true order of bits is smooth."""
    rng = np.random.default_rng(0)
    scene = np.where(np.arange(512) // 4 % 2 == 0, 0.05, 0.9) * np.ones((512, 1))
    planes = (rng.random((32, 512, 512)) < scene).astype(np.uint8)
    path = tmp_path / "texture.bin"
    path.write_bytes(np.packbits(planes, axis=2, bitorder=bits).tobytes())
    with pytest.raises(ValueError, match="choose one with layout=") as refused:
        detection.detect(path)
    found = dict(re.findall(r"(\S+) \(roughness ([0-9.]+)\)", str(refused.value)))
    least = min(found, key=lambda name: float(found[name]))
    assert least == layout or "too rough to tell" in str(refused.value)


def test_a_full_plane_read_as_two_halves_is_no_smoother(tmp_path):
    """The halves of a bright shape alternate, which once passed for the noise of a smooth scene."""
    rows = np.arange(512)[:, None] - 128
    columns = np.arange(512) - 256
    scene = np.where(rows**2 + columns**2 < 150**2, 0.98, 0.02)
    planes = (np.random.default_rng(0).random((12, 512, 512), np.float32) < scene).astype(np.uint8)
    path = tmp_path / "shape.bin"
    path.write_bytes(raw_planes.spad512s(planes))
    with pytest.raises(ValueError, match="choose one with layout=") as refused:
        detection.detect(path)
    found = dict(re.findall(r"(\S+) \(roughness ([0-9.]+)\)", str(refused.value)))
    assert min(found, key=lambda name: float(found[name])) == "spad512s"
