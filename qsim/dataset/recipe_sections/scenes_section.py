"""Reads a section [[scenes]] of a recipe: the jobs of its family, seeds and speeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qsim import checks
from qsim.checks import MAX_PIXELS
from qsim.dataset.job import Job, Settings
from qsim.dataset.recipe_sections.toml_section import Section
from qsim.files import check_name
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES, animated_file, animations_in
from qsim.scene.camera_path import PLAIN, read_camera_path
from qsim.streams.sensing import Sensing
from qsim.structure import Check, Table

MAX_STEM = 180  # characters of a scene's name, which gets a seed, a speed and a temporary ending as a file's name
SETTINGS: dict[str, Check] = {
    "frames": checks.whole,
    "height": checks.whole,
    "width": checks.whole,
    "frame_rate": checks.frame_rate,
    "shutter": checks.shutter,
    "psnr": checks.psnr,
    "bands": checks.bands,
    "camera_path": checks.text,
    "reuse": checks.flag,
}
SCENES: Table = {
    "family": checks.text,
    "seeds, if any": checks.list_of(checks.seed),
    "count, if any": checks.whole,
    "first, if any": checks.seed,
    "speed, if any": checks.list_of(checks.speed),
    "split, if any": checks.split,
    **{f"{key}, if any": check for key, check in SETTINGS.items()},
}


def jobs_of(section: Section, defaults: dict[str, Any], seed: int, streams: tuple[Sensing, ...]) -> list[Job]:
    """Return one job per seed and speed of a [[scenes]] section."""
    given = section.values(SCENES)
    family = _family(section, given["family"])
    seeds = _seeds(section, given)
    speeds = given.get("speed", [1.0])
    split = given.get("split", "train")
    settings = Settings(**(defaults | settings_of(section, given)))
    if family.endswith(".xml") and speeds != [1.0] and settings.camera_path is None:
        why = "an .xml scene has no motion, so speed changes nothing; leave it out"
        raise ValueError(f"{section.where('speed')}: {why}")
    if settings.height * settings.width > MAX_PIXELS:
        size = f"frames of {settings.height} x {settings.width} pixels"
        raise ValueError(f"{section.where()}: {size}; at most {MAX_PIXELS} pixels are rendered")
    stem = Path(family).stem
    with section.naming("family", "clips are named after the scene: "):
        check_name(f"{stem}_{seeds[0]:04d}")
    if len(stem) > MAX_STEM:
        long = f"whose name has {len(stem)} characters; at most {MAX_STEM}"
        raise ValueError(f"{section.where('family')}: clips are named after the scene, {long}")
    return [
        Job(
            name=f"{stem}_{s:04d}" + ("" if speed == 1 else f"_x{speed:g}"),
            family=family,
            scene_seed=s,
            speed=speed,
            split=split,
            settings=settings,
            seed=seed,
            streams=streams,
        )
        for s in seeds
        for speed in speeds
    ]


def settings_of(section: Section, given: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `Settings` that a section gives; a camera path beside the recipe is read, to be checked."""
    found = {key: given[key] for key in SETTINGS if key in given}
    if "camera_path" in found:
        file = (section.text.path.parent / found["camera_path"]).resolve()
        with section.naming("camera_path", "camera_path: "):
            read_camera_path(file, frame_rate=1.0, size=(PLAIN.height, PLAIN.width))
        found["camera_path"] = str(file)
    return found


def _family(section: Section, family: str) -> str:
    """Return a family of the library, or the absolute path of an existing scene file or folder."""
    file = (section.text.path.parent / family).resolve()
    if "/" in family and file.is_dir():
        return str(file)
    if family.endswith((".py", ".xml", *GLTF_SUFFIXES)):
        if not file.is_file():
            raise ValueError(f"{section.where('family')}: no such scene file {file}")
        if family.endswith(GLTF_SUFFIXES):
            _check_animations(section, file)
        return str(file)
    from qsim.scenes import FAMILIES

    if family not in FAMILIES:
        meant = f"{family!r}{checks.suggest(family, FAMILIES)}; there are: {', '.join(sorted(FAMILIES))}"
        raise ValueError(f"{section.where('family')}: unknown family {meant}")
    return family


def _check_animations(section: Section, file: Path) -> None:
    """`ValueError` with the line of the recipe if an animation of a glTF file cannot be read."""
    try:
        names: list[str | None] = [*animations_in(file)]
        for name in names or [None]:
            animated_file(file, animation=name)
    except (ValueError, OSError) as error:
        raise ValueError(f"{section.where('family')}: {error}") from None


def _seeds(section: Section, given: dict[str, Any]) -> list[int]:
    """Return the seeds of a section, listed or counted."""
    if "seeds" in given:
        if other := next((key for key in ("count", "first") if key in given), None):
            raise ValueError(f"{section.where(other)}: give either seeds or count, not both")
        return list(given["seeds"])
    first = given.get("first", 0)
    count = given.get("count", 1)
    if first + count > 2**31:
        key = "count" if "count" in given else "first"
        raise ValueError(f"{section.where(key)}: seeds {first} to {first + count - 1}; the largest is 2^31 - 1")
    return list(range(first, first + count))
