"""Installs qsim as people do, tells README's first story, and prints one row per installation.

    python benchmarks/install.py                                       # pip, with this Python
    python benchmarks/install.py python3.11 python3.12 --uv uv -o table.md
    python benchmarks/install.py --conda micromamba                    # conda's Python

Each row starts from a wheel of this tree and an empty environment. Its user has no root rights (started by root, the
program takes the user --uid), a home that cannot be written, and a PATH with the environment alone: no git, no make, no
compiler. A last row per Python is an environment that its owner never starts and that its user may not write.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
KEPT = re.compile(r"PIP_.*|UV_.*|CONDA_.*|SSL_CERT_.*|REQUESTS_CA_BUNDLE|CURL_CA_BUNDLE|.*_proxy", re.IGNORECASE)
STORY = (
    "qsim render fan -o out/fan --frames 12 --height 32 --width 32 --speed 4 --psnr 20",
    "qsim sense out/fan --ppp 3.25 --bits 3",
    "quiver restore out/fan -o out/fan.npy",
    "qsim report out/fan out/fan.npy -o out/fan.html",
)
WITHOUT_QUIVER = (*STORY[:2], "qsim report out/fan -o out/fan.html")  # where the extra `networks` is missing
HEADINGS = ("installer", "Python", "extras", "renderer", "install [s], of processor", "story [s], of processor", "MB")


@dataclass
class Place:
    """A folder for one installation: its environment, work, home and temporary files; and who uses it."""

    folder: Path
    uid: int | None
    seconds: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("environment", "work", "home", "tmp"):
            (self.folder / name).mkdir(parents=True)
            if self.uid is not None and name != "home":
                os.chown(self.folder / name, self.uid, self.uid)
        (self.folder / "home").chmod(0o555)

    @property
    def environment(self) -> Path:
        """The folder of the environment."""
        return self.folder / "environment"

    def run(self, step: str, *words: str | Path, as_owner: bool = False) -> str:
        """Run a command and add its time to `step`; return what it printed. `RuntimeError` if it fails."""
        variables = {name: value for name, value in os.environ.items() if KEPT.fullmatch(name)}
        variables |= {"PATH": str(self.environment / "bin"), "HOME": str(self.folder / "home"), "LANG": "C.UTF-8"}
        uid = None if as_owner else self.uid
        started = time.perf_counter()
        spent = _processor_time()
        ended = subprocess.run(
            [str(word) for word in words],
            cwd=self.folder / "work",
            env=variables | {"TMPDIR": str(self.folder / "tmp")},
            user=uid,
            group=uid,
            extra_groups=None if uid is None else [],
            capture_output=True,
            text=True,
            check=False,
        )
        wall, processor = self.seconds.get(step, (0.0, 0.0))
        self.seconds[step] = (wall + time.perf_counter() - started, processor + _processor_time() - spent)
        if ended.returncode:
            lines = (ended.stderr + ended.stdout).strip().splitlines() or ["no message"]
            raise RuntimeError(
                f"`{' '.join(str(word) for word in words[:4])} …` exits with {ended.returncode}: {lines[-1]}"
            )
        return ended.stdout


def _processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def build_wheel(folder: Path) -> Path:
    """Return the wheel of this tree, built from a copy (building leaves files beside it); beside it the constraints."""
    copy = folder / "copy"
    copy.mkdir()
    for name in ("qsim", "quiver", "scenes"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    shutil.copy(ROOT / "constraints.txt", folder)
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, copy], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(place: Place, installer: str, tool: str, python: str, what: Sequence[str]) -> None:
    """Make the environment and install `what` (words of pip) into it."""
    owner = installer == "pip, by another user"
    if installer == "uv":
        uv = (tool, "--no-cache", "--quiet")
        place.run("install", *uv, "venv", "--no-python-downloads", "--python", python, place.environment)
        place.run("install", *uv, "pip", "install", "--python", place.environment / "bin" / "python", *what)
        return
    if installer == "conda":
        place.run("install", tool, "create", "-y", "-q", "-p", place.environment, f"python={python}", "pip")
    else:
        place.run("install", python, "-m", "venv", place.environment, as_owner=owner)
    pip = (place.environment / "bin" / "python", "-m", "pip", "--quiet", "--disable-pip-version-check")
    place.run("install", *pip, "install", "--no-cache-dir", *what, as_owner=owner)


def row(place: Place, installer: str, tool: str, python: str, wheel: Path, extras: str) -> tuple[str, ...]:
    """Install and tell the story; return the row, which ends with the reason where a step failed."""
    bracket = f"[{extras}]" if extras else ""
    what = ("-c", str(wheel.parent / "constraints.txt"), f"qsim{bracket} @ {wheel.as_uri()}")
    version = python
    renderer = "none"
    try:
        install(place, installer, tool, python, what)
        programs = place.environment / "bin"
        version = place.run(
            "version", programs / "python", "-c", "import platform as p; print(p.python_version())"
        ).strip()
        renderer = json.loads(place.run("doctor", programs / "qsim", "doctor", "--json"))["reason"].split(",")[0]
        restores = "networks" in extras
        for line in STORY if restores else WITHOUT_QUIVER:
            program, *words = line.split()
            place.run("story", programs / program, *words)
    except RuntimeError as error:
        return (installer, version, extras, renderer, f"FAILED: {error}", "", "")
    times = [f"{wall:.0f}, {processor:.0f}" for wall, processor in (place.seconds["install"], place.seconds["story"])]
    size = sum(file.lstat().st_size for file in place.environment.rglob("*")) / 1e6
    return (installer, version, extras, renderer, *times, f"{size:.0f}")


def main() -> int:
    """Run every installation that was asked for; exit code 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python", nargs="*", default=[sys.executable], help="interpreters (default: this one)")
    parser.add_argument("--uv", metavar="PROGRAM", help="install with uv, too")
    parser.add_argument("--conda", metavar="PROGRAM", help="install into conda's Python, too (conda, micromamba)")
    parser.add_argument("--extras", default="llvm,networks", help="of the wheel (default: llvm,networks)")
    parser.add_argument("--uid", type=int, default=65534, help="of the user, if root runs this (default: 65534)")
    parser.add_argument("-o", "--output", type=Path, help="write the table to this file, too")
    args = parser.parse_args()
    uid = args.uid if os.geteuid() == 0 else None
    cases = [("pip", python, python) for python in args.python]
    cases += [("uv", args.uv, python) for python in args.python if args.uv]
    cases += [("conda", args.conda, f"{sys.version_info[0]}.{sys.version_info[1]}")] if args.conda else []
    cases += [("pip, by another user", python, python) for python in args.python if uid is not None]
    lines = ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        wheel = build_wheel(folder)
        for number, (installer, tool, python) in enumerate(cases):
            place = Place(folder / str(number), uid)
            lines.append("| " + " | ".join(row(place, installer, tool, python, wheel, args.extras)) + " |")
            print(lines[-1], flush=True)
            shutil.rmtree(place.folder)
    table = "\n".join(lines) + "\n"
    print(table)
    if args.output:
        args.output.write_text(table)
    return int("FAILED" in table)


if __name__ == "__main__":
    sys.exit(main())
