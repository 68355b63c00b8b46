"""Generation on a disk that is full at any moment: one clear error, and resuming gives the same bytes."""

import builtins
import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fakes import (
    HERE,
    SMALL,
    make,
    tree,
)

from qsim import files
from qsim.dataset import job_runner
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import generate


class FullDisk:
    """Open files on a disk with `space` bytes left; a write that does not fit writes what fits, then ENOSPC."""

    def __init__(self, space: int) -> None:
        self.space = space

    def open(self, path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        file = builtins.open(path, mode, *args, **kwargs)  # noqa: SIM115
        return _Limited(file, self) if "w" in mode or "a" in mode else file


class _Limited:
    def __init__(self, file: Any, disk: FullDisk) -> None:
        self.file = file
        self.disk = disk

    def write(self, content: Any) -> int:
        fits = min(len(content), self.disk.space)
        self.disk.space -= fits
        self.file.write(content[:fits])
        if fits < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return len(content)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def __enter__(self) -> "_Limited":
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()


def test_a_full_disk_everywhere(tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch):
    """Space for 0, 1/10, ... of a run: one clear error, nothing accepted, and resuming gives the same bytes."""
    measure = FullDisk(1 << 30)
    with monkeypatch.context() as patch:
        for module in (files, job_runner):
            patch.setattr(module, "open", measure.open, raising=False)
        generate(SMALL, tmp_path / "whole", HERE, make=make)
    needed = (1 << 30) - measure.space
    for step in range(10):
        folder = tmp_path / f"d{step}"
        disk = FullDisk(needed * step // 10)
        with monkeypatch.context() as patch:
            for module in (files, job_runner):
                patch.setattr(module, "open", disk.open, raising=False)
            with pytest.raises(OSError, match=r"No space left on device.*make space and run the same command again"):
                generate(SMALL, folder, HERE, make=make)
        if (folder / "dataset.json").is_file():
            assert all(clip.verify() == [] for clip in Dataset.open(folder).clips())
        assert generate(SMALL, folder, HERE, make=make).done == 3
        assert tree(folder) == undisturbed
        shutil.rmtree(folder)


class FullAt:
    """Let every operation that needs space fail from the n-th on: open, write, sync, rename, mkdir."""

    def __init__(self, left: int, patch: pytest.MonkeyPatch) -> None:
        self.left = left
        for module in (files, job_runner):
            patch.setattr(module, "open", self.open, raising=False)
        for name in ("fsync", "replace", "mkdir"):
            patch.setattr(os, name, self.guarded(getattr(os, name)))

    def guarded(self, action: Callable[..., Any]) -> Callable[..., Any]:
        def act(*args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if self.left < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return action(*args, **kwargs)

        return act

    def open(self, path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if "r" in mode:
            return builtins.open(path, mode, *args, **kwargs)
        file = self.guarded(builtins.open)(path, mode, *args, **kwargs)
        return _Guarded(file, self.guarded(file.write))


class _Guarded:
    def __init__(self, file: Any, write: Callable[..., Any]) -> None:
        self.file = file
        self.write = write

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)

    def __enter__(self) -> "_Guarded":
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()


@pytest.mark.parametrize("stride", [23, pytest.param(1, marks=pytest.mark.slow)])
def test_a_disk_that_is_full_from_any_operation_on(
    tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, stride: int
):
    """Every operation of a run that may fail with ENOSPC, one after the other (in the quick tests: one in 23)."""
    plenty = 1 << 30
    with monkeypatch.context() as patch:
        measure = FullAt(plenty, patch)
        generate(SMALL, tmp_path / "whole", HERE, make=make)
        needed = plenty - measure.left
    assert needed > 200
    for left in range(0, needed, stride):
        folder = tmp_path / f"d{left}"
        with monkeypatch.context() as patch:
            FullAt(left, patch)
            with pytest.raises(OSError, match=r"No space left on device.*make space and run the same command again"):
                generate(SMALL, folder, HERE, make=make)
        if (folder / "dataset.json").is_file():
            for clip in Dataset.open(folder).clips():
                assert clip.verify() == []
        assert generate(SMALL, folder, HERE, make=make).done == 3, left
        assert tree(folder) == undisturbed, left
        shutil.rmtree(folder)


def test_a_disk_that_is_really_full(tmp_path: Path, undisturbed: dict[str, bytes]):
    mount = tmp_path / "tmpfs"
    mount.mkdir()
    tried = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=96k", "tmpfs", str(mount)], capture_output=True)
    if tried.returncode != 0:
        pytest.skip("a tmpfs may not be mounted here; the injected full disk is tested in any case")
    try:
        with pytest.raises(OSError, match=r"No space left on device.*make space"):
            generate(SMALL, mount / "d", HERE, make=make)
        subprocess.run(["mount", "-o", "remount,size=16m", str(mount)], check=True)
        assert generate(SMALL, mount / "d", HERE, make=make).done == 3
        assert tree(mount / "d") == undisturbed
    finally:
        subprocess.run(["umount", str(mount)], check=True)
