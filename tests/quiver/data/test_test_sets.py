"""Test sets of the paper, in folders made exactly as they are published: sizes, grey values, numbers of windows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray as Array
from PIL import Image

from qsim.formats.video import write_video
from quiver.cli.program import main
from quiver.data import test_sets
from quiver.data.test_sets import TEST_SETS, counted, grey, import_test_set, resized

I2 = TEST_SETS["quiver-published"]
X4K = TEST_SETS["x4k1000fps"]


def moving(frames: int, height: int, width: int, seed: int) -> Array:
    """Grey frames of 8 bits [T, H, W]: smooth texture that moves one pixel per frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, : width + frames].astype(float)
    waves = sum(np.sin(a * x + b * y + c) for a, b, c in rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 6), (5, 3)))
    picture = np.rint(120 + 25 * waves).clip(1, 255).astype(np.uint8)
    return np.stack([picture[:, t : t + width] for t in range(frames)])


def i2(folder: Path, lengths: tuple[int, ...], size: tuple[int, int] = (32, 48)) -> Path:
    """A flat folder of mp4 files, as each split of I2-2000FPS."""
    folder.mkdir()
    for i, frames in enumerate(lengths):
        write_video(folder / f"test_{i:05d}.mp4", iter(moving(frames, *size, i)), 30, lossless=True)
    return folder


def x4k(folder: Path, clips: int, frames: int = 33, size: tuple[int, int] = (36, 68)) -> Path:
    """test/TypeN/TESTNN/0000.png ..., in colour, as the test set of X4K1000FPS."""
    for i in range(clips):
        place = folder / f"Type{i % 3 + 1}" / f"TEST{i + 1:02d}_000_f0433"
        place.mkdir(parents=True)
        for t, frame in enumerate(moving(frames, *size, i)):
            colour = np.stack([frame, frame // 2, 255 - frame], axis=-1)
            Image.fromarray(colour).save(place / f"{t:04d}.png")
    return folder


def evaluation(folder: Path, out: Path) -> list[str]:
    """The command that scores a small test set by the quickest method."""
    return ["evaluate", str(folder), "-o", str(out), "--protocol", "quiver-published", "--methods", "naive", "-q"]


def test_grey_has_the_weights_of_the_published_reader():
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    red, green, blue = (colour[..., i].astype(float) for i in range(3))
    exact = 0.299 * red + 0.587 * green + 0.114 * blue
    assert np.abs(grey(colour) - exact).max() <= 0.5 + 1e-9
    alike = np.repeat(colour[..., :1], 3, axis=2)
    np.testing.assert_array_equal(grey(alike), alike[..., 0])  # grey in three channels stays as it is
    np.testing.assert_array_equal(grey(colour[..., 0]), colour[..., 0])


def cubic(t: float, a: float = -0.75) -> float:
    t = abs(t)
    if t <= 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * t**3 - 5 * a * t**2 + 8 * a * t - 4 * a if t < 2 else 0.0


def test_a_change_of_size_is_bicubic_without_antialiasing():
    """Against a slow sum over 4 x 4 neighbours, repeated beyond the edge, at random sizes."""
    rng = np.random.default_rng(1)
    for _ in range(3):
        (h, w), (oh, ow) = rng.integers(5, 12, (2, 2))
        frame = rng.integers(0, 256, (h, w), dtype=np.uint8)
        slow = np.zeros((oh, ow))
        for i in range(oh):
            for j in range(ow):
                y = (i + 0.5) * h / oh - 0.5
                x = (j + 0.5) * w / ow - 0.5
                for m in range(int(np.floor(y)) - 1, int(np.floor(y)) + 3):
                    for n in range(int(np.floor(x)) - 1, int(np.floor(x)) + 3):
                        value = float(frame[min(max(m, 0), h - 1), min(max(n, 0), w - 1)])
                        slow[i, j] += cubic(y - m) * cubic(x - n) * value
        assert np.abs(resized(frame, (int(oh), int(ow))) - slow.clip(0, 255)).max() <= 0.5 + 1e-2
    np.testing.assert_array_equal(resized(frame, frame.shape), frame)


def test_a_folder_of_videos_becomes_clips_of_grey_values(tmp_path):
    """Names, frame rate, and every grey value / 255 as it is in the file, to the precision of a half float."""
    clips = import_test_set(i2(tmp_path / "test", (13, 11)), I2, tmp_path / "out")
    assert [clip.name for clip in clips] == ["test_00000", "test_00001"]
    assert [clip.shape for clip in clips] == [(13, 32, 48), (11, 32, 48)]
    assert (clips[0].frame_rate, clips[0].exposure) == (2000.0, 5e-4)
    for t in (0, 12):
        wanted = moving(13, 32, 48, 0)[t] / 255
        assert np.abs(clips[0].radiance(t) - wanted).max() <= 2.0**-11
    assert counted(clips, I2) == "quiver-published: 2 clips, 4 windows; the published set has 31 clips and 6017 windows"


def test_a_tree_of_pictures_becomes_clips_of_the_loaders_size(tmp_path):
    small = replace(X4K, size=lambda height, width: (16, 32))
    clips = import_test_set(x4k(tmp_path / "test", 2, frames=11), small, tmp_path / "out")
    assert [clip.name for clip in clips] == ["Type1_TEST01_000_f0433", "Type2_TEST02_000_f0433"]
    assert {clip.shape for clip in clips} == {(11, 16, 32)}
    frame = moving(11, 36, 68, 0)[4]
    wanted = resized(grey(np.stack([frame, frame // 2, 255 - frame], axis=-1)), (16, 32)) / 255
    assert np.abs(clips[0].radiance(4) - wanted).max() <= 2.0**-11
    assert X4K.size(2160, 4096) == (512, 1024)


def test_windows_are_counted_as_published(tmp_path):
    """345 windows of 15 clips of 33 frames: one for each but the first and last five frames of a clip."""
    tiny = replace(X4K, size=lambda height, width: (8, 8))
    clips = import_test_set(x4k(tmp_path / "test", 1, size=(8, 8)), tiny, tmp_path / "out")
    assert counted(15 * clips, X4K) == "x4k1000fps: 15 clips, 345 windows, as published"


def test_clips_are_imported_once_and_not_mixed(tmp_path):
    folder = i2(tmp_path / "test", (11,))
    import_test_set(folder, I2, tmp_path / "out")
    written = (tmp_path / "out/test_00000/clip.json").stat().st_mtime_ns
    import_test_set(folder, I2, tmp_path / "out")
    assert (tmp_path / "out/test_00000/clip.json").stat().st_mtime_ns == written
    with pytest.raises(ValueError, match=r"is a clip of .*choose another"):
        import_test_set(i2(tmp_path / "other", (11,)), I2, tmp_path / "out")


@pytest.mark.parametrize(
    ("lengths", "message"), [((), "holds no videos"), ((10,), "10 frames; a published window has 11")]
)
def test_folders_that_hold_no_window_are_refused(tmp_path, lengths, message):
    with pytest.raises(ValueError, match=message):
        import_test_set(i2(tmp_path / "test", lengths), I2, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_unless_every_recording_fits(tmp_path):
    """The last one is too short, or its place holds another clip."""
    folder = i2(tmp_path / "test", (12, 11, 10))
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"test_00002\.mp4: 10 frames; a published window has 11"):
        import_test_set(folder, I2, out)
    assert not out.exists()
    write_video(folder / "test_00002.mp4", iter(moving(11, 32, 48, 2)), 30, lossless=True)
    only = tmp_path / "only"
    only.mkdir()
    (folder / "test_00002.mp4").rename(only / "test_00002.mp4")
    import_test_set(only, I2, out)
    write_video(folder / "test_00002.mp4", iter(moving(11, 32, 48, 3)), 30, lossless=True)
    with pytest.raises(ValueError, match=r"test_00002: is a clip of .*choose another"):
        import_test_set(folder, I2, out)
    assert [clip.name for clip in out.iterdir()] == ["test_00002"]


def stray(folder: Path) -> None:
    """What systems and archives leave beside pictures, and pictures in capitals."""
    first = folder / "Type1/TEST01_000_f0433"
    for name in (".DS_Store", "README.txt", "test.zip", "Type1/.DS_Store", "__MACOSX/Type1/._0000.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")
    (first / "._0000.png").write_text("x")
    (first / "Thumbs.db").write_text("x")
    (first / "0003.png").rename(first / "0003.PNG")


def test_files_that_are_no_pictures_change_nothing(tmp_path):
    tiny = replace(X4K, size=lambda height, width: (16, 32))
    plain, other = (x4k(tmp_path / name, 2, frames=12) for name in ("plain", "stray"))
    stray(other)
    wanted, found = (import_test_set(folder, tiny, tmp_path / f"{folder.name}_out") for folder in (plain, other))
    assert [clip.name for clip in found] == [clip.name for clip in wanted]
    for a, b in zip(found, wanted, strict=True):
        assert a.shape == b.shape
        assert all(np.array_equal(a.radiance(t), b.radiance(t)) for t in range(12))


def without_a_frame(folder: Path) -> None:
    (folder / "Type1/TEST01_000_f0433/0005.png").unlink()


def as_tiff(folder: Path) -> None:
    for file in folder.rglob("*.png"):
        Image.open(file).save(file.with_suffix(".tif"))
        file.unlink()


def with_a_video(folder: Path) -> None:
    write_video(folder / "preview.mp4", iter(moving(11, 16, 16, 0)), 30, lossless=True)


def under_two_names(folder: Path) -> None:
    (folder / "Type1/TEST01_000_f0433").rename(folder / "Type2/TEST02 000_f0433")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_a_frame, r"TEST01_000_f0433: no frame is between 0004\.png and 0006\.png; add what is missing"),
        (as_tiff, r"TEST01_000_f0433: holds no \.png; give its frames as PNG"),
        (with_a_video, "holds videos and folders of pictures .*; name the folder of one kind"),
        (under_two_names, "would both be clip Type2_TEST02_000_f0433; rename one"),
    ],
)
def test_folders_that_would_be_read_wrongly_are_refused(tmp_path, change, message):
    folder = x4k(tmp_path / "test", 2, frames=12)
    change(folder)
    with pytest.raises(ValueError, match=message):
        import_test_set(folder, X4K, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_recording_that_grew_is_not_taken_for_its_clip(tmp_path):
    folder = i2(tmp_path / "test", (11,))
    import_test_set(folder, I2, tmp_path / "out")
    write_video(folder / "test_00000.mp4", iter(moving(12, 32, 48, 0)), 30, lossless=True)
    with pytest.raises(ValueError, match=r"with 11 frames, not of .* with 12; choose another"):
        import_test_set(folder, I2, tmp_path / "out")


@pytest.mark.parametrize("ending", ["", ".part"])
def test_clips_of_another_folder_are_not_scored_along(tmp_path, ending):
    """An interrupted import of the wrong folder leaves them."""
    out = tmp_path / "out"
    import_test_set(i2(tmp_path / "one", (11,)), I2, out)
    (out / "test_00000").rename(out / f"test_00000{ending}")
    other = tmp_path / "other"
    other.mkdir()
    write_video(other / "x.mp4", iter(moving(11, 32, 48, 5)), 30, lossless=True)
    with pytest.raises(ValueError, match=rf"test_00000{ending}: is no clip of .*other; choose another"):
        import_test_set(other, I2, out)
    assert not (out / "x").exists()


def test_a_recording_that_was_replaced_is_not_taken_for_its_clip(tmp_path):
    """Neither a video nor one picture of a folder."""
    small = replace(X4K, size=lambda height, width: (16, 32))
    videos = i2(tmp_path / "videos", (11,))
    pictures = x4k(tmp_path / "pictures", 1, frames=11)
    out = tmp_path / "out"
    import_test_set(videos, I2, out / "i2")
    import_test_set(pictures, small, out / "x4k")
    write_video(videos / "test_00000.mp4", iter(moving(11, 32, 48, 7)), 30, lossless=True)
    Image.fromarray(np.zeros((36, 68, 3), np.uint8)).save(pictures / "Type1/TEST01_000_f0433/0004.png")
    with pytest.raises(ValueError, match=r"test_00000\.mp4 was changed since it became this clip; choose another"):
        import_test_set(videos, I2, out / "i2")
    with pytest.raises(ValueError, match=r"TEST01_000_f0433 was changed since it became this clip"):
        import_test_set(pictures, small, out / "x4k")


def test_an_interrupted_import_is_not_finished_with_another_recording(tmp_path, monkeypatch):
    folder = i2(tmp_path / "test", (11,))
    out = tmp_path / "out"
    done = []

    def interrupted(frame: Array, size: tuple[int, int]) -> Array:
        done.append(frame)
        if len(done) == 5:
            raise KeyboardInterrupt
        return frame

    with monkeypatch.context() as patch:
        patch.setattr(test_sets, "resized", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_test_set(folder, I2, out)
    before = (folder / "test_00000.mp4").read_bytes()
    write_video(folder / "test_00000.mp4", iter(moving(11, 32, 48, 7)), 30, lossless=True)
    with pytest.raises(ValueError, match="4 frames exist, begun with other settings"):
        import_test_set(folder, I2, out)
    (folder / "test_00000.mp4").write_bytes(before)
    assert len(import_test_set(folder, I2, out)[0]) == 11


@pytest.mark.parametrize("name", ["none", "file"])
def test_a_folder_that_is_none_is_told(tmp_path, name, capsys):
    (tmp_path / "file").write_text("x")
    words = ["evaluate", str(tmp_path / name), "-o", str(tmp_path / "out"), "--protocol", "x4k1000fps"]
    assert main(words) == 2
    assert "no such folder; name the folder of the test set" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_command_scores_windows_as_published(tmp_path, capsys):
    """A method that returns the mean light: its factor per window is right, its raw score is that of its brightness."""
    folder = i2(tmp_path / "test", (13, 11))
    out = tmp_path / "table"
    words = ["evaluate", str(folder), "-o", str(out), "--protocol", "quiver-published", "--methods", "moment:11"]
    assert main([*words, "--ppp", "3.25,26"]) == 0
    shown = capsys.readouterr()
    assert "2 clips, 4 windows; the published set has 31 clips and 6017 windows" in shown.err
    assert "peak = grey 255, as published" in shown.out
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    assert [row["score"]["frames"] for row in rows] == [3, 1, 3, 1]
    assert {row["light"] for row in rows} == {"3.25 PPP, 3 bit", "26 PPP, 3 bit"}
    assert main([*words, "--ppp", "3.25,26"]) == 0  # again: nothing is computed
    assert len((out / "rows.jsonl").read_text().splitlines()) == 4
    capsys.readouterr()
    for more in (["--bits", "3"], ["--published"], ["--sensor", "quiver-paper"], ["--peak", "8"], ["--split", "test"]):
        assert main([*words, *more]) == 2
        assert "--protocol quiver-published" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0
    assert len((out / "rows.jsonl").read_text().splitlines()) == 2


def test_the_table_says_what_was_scored(tmp_path):
    folder = i2(tmp_path / "test", (13, 11), (16, 16))
    out = tmp_path / "table"
    assert main(evaluation(folder, out)) == 0
    scored = f"2 clips, 4 windows; the published set has 31 clips and 6017 windows; read from {folder}"
    text = (out / "evaluation.md").read_text()
    assert scored in text
    assert text.splitlines()[0].endswith("split all, 2 clips")
    assert json.loads((out / "evaluation.json").read_text())["remarks"] == [f"quiver-published: {scored}"]


def test_force_keeps_what_was_not_imported(tmp_path, capsys):
    """Nothing goes before the test set was read; a file among the clips stays, and so does a set in their place."""
    folder = i2(tmp_path / "test", (11,), (16, 16))
    out = tmp_path / "table"
    words = evaluation(folder, out)
    assert main(words) == 0
    before = (out / "rows.jsonl").read_bytes()
    assert main([*evaluation(tmp_path / "tset", out), "--force"]) == 2
    assert "tset: no such folder" in capsys.readouterr().err
    mine = out / "clips/test_00000/holiday.mp4"
    mine.write_text("mine")
    assert main([*words, "--force"]) == 2
    assert "holiday.mp4: was not made by this program" in capsys.readouterr().err
    assert mine.read_text() == "mine"
    assert (out / "rows.jsonl").read_bytes() == before
    mine.unlink()
    assert main([*words, "--force"]) == 0

    folder.rename(tmp_path / "clips")
    for more in ([], ["--force"]):
        assert main([*evaluation(tmp_path / "clips", tmp_path), *more]) == 2
        assert "overlaps with" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "clips").iterdir()] == ["test_00000.mp4"]


def test_force_begins_an_interrupted_import_again(tmp_path):
    folder = i2(tmp_path / "test", (11,), (16, 16))
    out = tmp_path / "table"
    import_test_set(i2(tmp_path / "wrong", (12, 12), (16, 16)), I2, out / "clips")
    assert main(evaluation(folder, out)) == 2
    assert main([*evaluation(folder, out), "--force"]) == 0
    assert [path.name for path in (out / "clips").iterdir()] == ["test_00000"]


@pytest.mark.slow
def test_the_command_scores_x4k_at_its_size(tmp_path, capsys):
    folder = x4k(tmp_path / "test", 1, frames=12, size=(54, 102))
    out = tmp_path / "table"
    assert main(["evaluate", str(folder), "-o", str(out), "--protocol", "x4k1000fps", "--methods", "naive:11"]) == 0
    assert "1 clips, 2 windows" in capsys.readouterr().err
    found = json.loads((out / "clips" / "Type1_TEST01_000_f0433" / "clip.json").read_text())
    assert found["shape"] == [12, 512, 1024]
