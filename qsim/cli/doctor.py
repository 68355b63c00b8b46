"""Runs `qsim doctor`: the renderer of this machine, and what is installed."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated

from qsim.cli.command import command
from qsim.cli.console import INSTALLED_AS, OPTIONAL, output
from qsim.settings import setting

if TYPE_CHECKING:
    from qsim.sensor.devices import ListedDevice


@dataclass(frozen=True)
class Doctor:
    """What `qsim doctor` prints."""

    devices: Annotated[bool, setting("list the named sensors and the source of each number")] = False


@command("qsim doctor", "qsim doctor --devices")
def doctor(asked: Doctor) -> int:
    """Print the renderer and the optional packages of this machine, or the numbers of the named sensors."""
    if asked.devices:
        from qsim.sensor import devices

        listing = devices.listing()
        output({"devices": listing}, [_device_text(device) for device in listing])
        return 0
    from qsim import backend
    from qsim.optics.camera import Camera
    from qsim.optics.diffraction import diffraction_line

    missing = {extra: [p for p in packages if not find_spec(p)] for extra, (packages, _) in OPTIONAL.items()}
    report = backend.report()
    facts = {
        **report,
        "extras": {extra: not packages for extra, packages in missing.items()},
        "lens": diffraction_line(Camera(8e-3, 2.8, 1.1e-6, 512, 1024)),
    }
    width = max(len(key) for key in facts)
    extras = [f"{extra}: {_extra_text(extra, packages)}" for extra, packages in missing.items()]
    probes = [f"{p['library'] or p['backend']}: {p['detail']}" for p in report["probes"]]
    words = facts | {
        "probes": ("\n" + " " * (width + 2)).join(probes),
        "software": ", ".join(f"{name} {found}" for name, found in report["software"].items()),
        "extras": ("\n" + " " * (width + 2)).join(extras),
    }
    output(facts, [f"{key:{width}}  {value}" for key, value in words.items()])
    return 0


def _extra_text(extra: str, missing: list[str]) -> str:
    """Return what an extra is for, and how to install the packages of it that are missing."""
    purpose = OPTIONAL[extra][1]
    names = [INSTALLED_AS.get(package, package) for package in missing]
    return f"MISSING (pip install {' '.join(names)}); for {purpose}" if missing else f"installed; for {purpose}"


def _device_text(device: ListedDevice) -> str:
    lines = [f"{device['name']}: {device['what']}"]
    lines += [f"    settings: {device['settings']}", f"    settings_at: {device['settings_at']}"]
    lines += [f"    {key}, source: {text}" for key, text in device["sources"].items()]
    return "\n".join(lines)
