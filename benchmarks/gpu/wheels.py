"""Installs wheels of packages that the machine lacks into the folder of results, without a network."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from folder import Wrong, version

REASON = 300  # letters of a message that are shown


def install(folder: Path, target: Path) -> None:
    """Install the wheels of packages that this machine lacks into `target`, which is complete or absent.

    Nothing is downloaded, built or replaced: no index, wheels alone, no dependencies, and the machine's packages stay.
    """
    if not folder.is_dir():
        raise Wrong(f"--wheels {folder}: no such folder")
    files = sorted(folder.glob("*.whl"))
    names = sorted({found[1] for file in files if (found := re.match(r"([A-Za-z0-9][A-Za-z0-9._]*)-\d", file.name))})
    missing = [name for name in names if version(name, Path(os.devnull)) is None]
    if not names:
        raise Wrong(f"--wheels {folder}: holds no .whl file")
    print(f"wheels of {len(names)} packages; this machine lacks {', '.join(missing) or 'none of them'}", flush=True)
    new = target.with_name(f"{target.name}.tmp-{os.getpid()}")
    pip = [sys.executable, "-m", "pip", "--isolated", "--quiet", "--disable-pip-version-check", "install", "--no-index"]
    pip += ["--no-cache-dir", "--no-deps", "--only-binary=:all:", "--find-links", str(folder.resolve())]
    try:
        new.mkdir()
        for name in missing:  # one by one: a wheel of another system must not keep out the others
            done = subprocess.run([*pip, "--target", str(new), "--", name], capture_output=True, text=True, check=False)
            if done.returncode:
                lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
                print(f"  {name}: not installed: {lines[-1][:REASON]}", flush=True)
        shutil.rmtree(target, ignore_errors=True)
        new.rename(target)
    finally:
        shutil.rmtree(new, ignore_errors=True)
