"""A disk that is really full under every command that writes: one line that names a file, and nothing left to read."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim import export, formats
from qsim.cli import main
from qsim.export import Export
from qsim.stream import Sensing, sense


@pytest.fixture
def full(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    mount = tmp_path / "tmpfs"
    mount.mkdir()
    tried = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(mount)], capture_output=True)
    if tried.returncode != 0:
        pytest.skip("a tmpfs may not be mounted here; an injected full disk is tested in test_dataset.py")
    yield mount
    subprocess.run(["umount", str(mount)], check=True)


def fails_in_one_line(capsys: pytest.CaptureFixture[str], line: str, where: Path) -> None:
    assert main(line.split()) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert str(where) in error
    assert "No space left on device" in error


@pytest.mark.parametrize("kind", ["cube", "mp4", "png", "exr", "zarr"])
def test_exports(tmp_path: Path, full: Path, kind: str):
    clip = write_clip(tmp_path / "clip", frames=16, height=64, width=128)
    source = sense(clip, Sensing("quiver-physical", 1, ppp=3.25))[0] if kind == "cube" else clip
    (full / "rest").write_bytes(bytes(60 << 10))
    with pytest.raises((OSError, ValueError), match="No space left on device"):
        export.export(source, full / "out", Export(kind))
    assert not (full / "out").exists()
    (full / "rest").unlink()
    subprocess.run(["mount", "-o", "remount,size=16m", str(full)], check=True)
    assert export.export(source, full / "out", Export(kind)).exists()


def test_sensing_and_importing(tmp_path: Path, full: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip", frames=16, height=64, width=128)
    for name, array in [("codes", np.ones((16, 64, 128), bool)), ("light", np.ones((16, 64, 128), np.float32))]:
        np.save(tmp_path / f"{name}.npy", array)
    (full / "rest").write_bytes(bytes(60 << 10))
    (clip.path / "streams").symlink_to(full)
    fails_in_one_line(capsys, f"sense {clip.path} --ppp 3.25 --bits 3", clip.path)
    assert clip.streams == ()
    for name in ("codes", "light"):
        fails_in_one_line(capsys, f"convert {tmp_path}/{name}.npy {full}/{name} --frame-rate 1000", full)
        assert not [path for path in full.iterdir() if path.name.startswith(name) and not path.name.endswith(".part")]
    with pytest.raises(FileNotFoundError, match=r"unfinished \(only light\.part is there\)|no such clip"):
        formats.Clip.open(full / "light")
