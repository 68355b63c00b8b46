"""Tests exports: codes and light of any size come back from every format."""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from fakes import RECIPE, make
from forks import forked
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from recordings import CAPTURE, SIZES, clip_of, everything

from qsim.cli.program import main
from qsim.dataset import generation, recipe
from qsim.dataset.dataset import Dataset
from qsim.formats import exporting, importing
from qsim.formats.exporting import Export
from qsim.formats.recording import Hints
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.scene import Spin, Translation
from qsim.scene.camera_path import read_camera_path
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import FixedPattern
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip


@pytest.mark.parametrize("bits", range(1, 9))
@pytest.mark.parametrize("width", [1, 7, 10, 33, 70])
def test_codes_through_our_stream_and_every_export(tmp_path: Path, bits: int, width: int):
    codes = np.random.default_rng(bits).integers(0, 2**bits, (3, 5, width)).astype(np.uint8)
    codes[0, 0, 0] = 0
    codes[0, 1, 0] = 1
    codes[0, 2, 0] = 2**bits - 1
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
        assert (meta["bits"], meta["shape"][2], meta["code_model"], meta["format_version"]) == (
            bits,
            width,
            "binary_sum",
            1,
        )


def said(kind: str, bits: int, width: int) -> dict[str, int]:
    """What has to be said to read an export of codes again: a hint that says nothing is refused."""
    if kind == "cube":
        return {"width": width}
    if kind == "png" and bits == 1:
        return {}
    return {"bits": bits}


@settings(max_examples=30, deadline=None)
@given(shape=SIZES, bits=st.integers(1, 16), seed=st.integers(0, 99))
def test_codes_of_any_size_and_depth_come_back(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], bits: int, seed: int
):
    """Stream -> PNG, zarr (and cube, MATLAB's parts) -> the same codes, at any size."""
    folder = tmp_path_factory.mktemp("any")
    values = np.random.default_rng(seed).integers(0, 2**bits, shape).astype(np.uint8 if bits <= 8 else np.uint16)
    np.save(folder / "codes.npy", values)
    stream = importing.to_stream(importing.read(folder / "codes.npy", Hints("codes", bits=bits)), folder / "s", CAPTURE)
    np.testing.assert_array_equal(stream.codes(), values)
    assert (stream.info.orientation, stream.shape) == ("upright", shape)
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
        steps = 65535 if kind == "png" else 255  # 8 bits lose dark light, so pictures of light have 16
        np.testing.assert_allclose(everything(path, transfer="linear"), light, atol=0.5 / steps + 1e-6)
    shutil.rmtree(folder)


def test_a_data_set_becomes_videos(tmp_path: Path):
    """`convert DATASET --to mp4`: a file per clip in the folder of its split, grey values rounded to half a code."""
    av = pytest.importorskip("av")
    generation.generate(recipe.parse(RECIPE), tmp_path / "small", generation.Options(workers=0), make=make)
    command = ["convert", str(tmp_path / "small"), str(tmp_path / "out"), "--to", "mp4"]
    assert main(command) == 0
    clips = Dataset.open(tmp_path / "small").clips()
    names = {f"{clip.info.split}/{clip.name}.mp4": clip for clip in clips}
    assert sorted(names) == ["test/tumble_0004.mp4", "train/fan_0000.mp4", "train/fan_0001.mp4"]
    made = [str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")]
    assert sorted(made) == sorted([*names, *(f"{name}.json" for name in names)])
    for name, clip in names.items():
        meta = json.loads((tmp_path / "out" / f"{name}.json").read_text())
        assert (meta["shape"], meta["frame_rate"], meta["split"]) == ([*clip.shape], 2000.0, clip.info.split)
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


def test_what_was_written_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    for kind, words in [
        ("mp4", "mp4, 2 frames of 6 x 8 pixels at 2000 per second, played at 30, light in 8 bits by gamma 2.2, white"),
        ("exr", "exr, 2 frames of 6 x 8 pixels at 2000 per second, linear light in W m^-2 sr^-1"),
    ]:
        assert main(["convert", str(clip.path), str(tmp_path / kind), "--to", kind]) == 0
        assert f"{tmp_path / kind}: {words}" in capsys.readouterr().out


@pytest.mark.parametrize("moves", [True, False])
def test_a_clip_is_written_with_its_camera_path(tmp_path: Path, moves: bool):
    """Pictures of 8 bits, and poses, view and lens of the window that the clip shows."""
    lens = Lens(-0.1, 0.02, shift=(0.05, -0.02))
    motion = Spin((0.2, 1, 0), 300.0) @ Translation((20.0, -10, 30)) if moves else None
    camera = Camera(2e-5, 2.8, 1e-6, 11, 15, lens=lens, origin=(1, 2, 3), motion=motion)
    poses = {"poses": [camera.pose(t / 2000.0).tolist() for t in range(4)]} if moves else {}
    clip = write_clip(tmp_path / "clip", frames=4, height=7, width=10, camera=camera, origin=[3, 4], **poses)
    assert main(["convert", str(clip.path), str(tmp_path / "out"), "--to", "nerfstudio"]) == 0
    found = read_camera_path(tmp_path / "out" / "transforms.json")
    assert (found.height, found.width) == (7, 10)
    for t in range(4):
        np.testing.assert_allclose(found.pose(t / 2000.0), camera.pose(t / 2000.0), atol=1e-9)
    points = camera.pose(0)[:3, 3] + camera.directions().reshape(-1, 3) @ camera.pose(0)[:3, :3].T
    np.testing.assert_allclose(found.project(points)[0], camera.project(points)[0] - (4, 3), atol=1e-9)
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for frame in content["frames"]:
        with Image.open(tmp_path / "out" / frame["file_path"]) as picture:
            assert (picture.mode, picture.size) == ("L", (10, 7))
    assert everything(tmp_path / "out", layout="png", transfer="gamma 2.2").shape == (4, 7, 10)


def test_clips_without_poses_have_no_camera_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    size = {"height": 7, "width": 10}
    for name, message, more in (
        ("relative", "has no camera", {"frames": 3, "relative": True}),
        ("one", "a camera path needs two or more", {"frames": 1}),
    ):
        write_clip(tmp_path / name, **size, **more)
        assert main(["convert", str(tmp_path / name), str(tmp_path / "out"), "--to", "nerfstudio"]) == 2
        assert message in capsys.readouterr().err
    stream = write_clip(tmp_path / "good", frames=3, **size).sense(ppp=1.0, bits=1)
    assert main(["convert", str(stream.path), str(tmp_path / "out"), "--to", "nerfstudio"]) == 2
    assert "is a stream, and poses belong to light" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_export_states_what_decides_its_codes(tmp_path: Path):
    """Defects, place in the frame and light level were left out: hot pixels had no reason."""
    camera = Camera(8e-3, 2.8, 1.1e-6, 11, 15)
    clip = write_clip(tmp_path / "clip", frames=2, height=7, width=10, camera=camera, origin=[3, 4])
    stream = clip.sense(BinarySPAD(0.4, 20.0), lux=50.0, defects=Defects(FixedPattern(dead=0.1)))
    exporting.export(stream, tmp_path / "a.npy", Export("cube"))
    meta = json.loads((tmp_path / "a.npy.json").read_text())
    assert (meta["defects"], meta["light"]["ppp"]) == (stream.info.defects, stream.info.light.ppp)
    assert (meta["origin"], meta["settings"]) == ([3, 4], {"lux": 50.0})


def test_an_export_does_not_replace_what_appeared_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clip = write_clip(tmp_path / "clip", frames=2)
    target = tmp_path / "out"
    real = exporting.EXPORTS["png"]

    def slow(*words: object) -> object:
        info = real(*words)
        target.mkdir()
        (target / "notes.txt").write_text("mine")
        return info

    monkeypatch.setitem(exporting.EXPORTS, "png", slow)
    for force, told in ((False, "out: appeared while it was written; move it away"), (True, "out: was not written by")):
        with pytest.raises(FileExistsError, match=told):
            exporting.export(clip, target, Export("png"), force=force)
        assert (target / "notes.txt").read_text() == "mine"
        shutil.rmtree(target)


def test_nothing_is_written_into_a_clip(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The description of an export in `streams` counted as a stream without codes."""
    clip = write_clip(tmp_path / "clip", frames=2, height=6, width=8)
    stream = clip.sense(BinarySPAD(0.4, 20.0), ppp=1.0)
    inside = clip.path / "streams"
    np.save(tmp_path / "planes.npy", stream.codes() > 0)
    np.save(tmp_path / "light.npy", np.ones((2, 6, 8), np.float32))
    for words in (
        ["convert", stream.path, inside / "cube.npy"],
        ["convert", clip.path, clip.path / "film.mp4"],
        ["convert", clip.path, inside / "pairs.h5", "--window", 2],
        ["convert", tmp_path / "planes.npy", inside / "capture", "--frame-rate", 9],
        ["convert", tmp_path / "light.npy", clip.path / "light", "--frame-rate", 9],
        ["preview", clip.path, "-o", inside / "a.png"],
    ):
        assert main([str(word) for word in words]) == 2
        told = capsys.readouterr().err
        assert f": lies in the clip {clip.path}, which holds nothing else; name another place" in told
    assert clip.streams == (stream.name,)
    assert main(["check", str(clip.path)]) == 0


def test_a_killed_export_is_made_again(tmp_path: Path, monkeypatch):
    """What the killed one left is provably ours, lies under no name of the user, and is gone after the next."""
    clip = clip_of(tmp_path / "clip", np.random.default_rng(0).random((3, 6, 8)).astype(np.float32))
    written = exporting._light_blocks
    target = tmp_path / "out"

    def killed(source: Clip):
        yield from written(source)
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(exporting, "_light_blocks", killed)
        os.waitpid(forked(lambda: exporting.export(clip, target, Export("png"))), 0)
    assert not target.exists()
    assert len(list(tmp_path.glob(".qsim-*/0/*.png"))) == 3
    (tmp_path / "out.part").mkdir()  # a name that an earlier version took for its own
    exporting.export(clip, target, Export("png"))
    assert sorted(item.name for item in tmp_path.iterdir()) == ["clip", "out", "out.part"]
