"""Reads a recipe, one TOML file, into the jobs of a data set; every error names file, line and key.

    [recipe]
    name = "starter"           # of the data set: letters, digits, '.', '_', '-'
    seed = 0                   # of the samples and of the noise; default 0
    frames = 21                # per clip
    height = 128               # pixels
    width = 128                # pixels
    frame_rate = 2000.0        # frames per second of the scene's time; default 2000
    shutter = 0.0              # open share of a frame; 0, the default: a sharp instant with the light of a full frame
    psnr = 40.0                # wanted error of the radiance, dB below white, clamped there; default 40
    bands = "rgb"              # colour: bands R, G and B; default: one band
    camera_path = "path.json"  # poses, view and distortion of the camera, a transforms.json; default: the scene's
    reuse = true               # sharp frames share samples with neighbours where that costs less; false: each alone;
                               # default: where a trial costs little against the clip

    [[scenes]]                 # one clip per family, seed and speed
    family = "fan"             # a family of scenes/; or a .py, .xml, .glb file or folder beside the recipe ("./things")
    seeds = [0, 1, 2]          # one clip each; or give count
    count = 3                  # clips of the seeds first ... first + count - 1
    first = 0                  # first seed of a count; default 0
    speed = [1.0, 2.0]         # factor on all motions, a number or a list; default 1
    split = "train"            # train, the default, val or test
    # frames, height, width, frame_rate, shutter, psnr, bands, camera_path, reuse: as above, for these scenes only

    [[streams]]                # optional; one stream per bits and light level, in every clip
    sensor = "quiver-physical" # a name of `qsim doctor --devices`, or a .toml file beside the recipe
    bits = [1, 3]              # of a code, a number or a list; default: the sensor's own
    ppp = [3.25, 26.0]         # photons per pixel and code, mean of the clip, a number or a list; or lux, or absolute
    lux = 1.3                  # faceplate lux at 555 nm instead of ppp, a number or a list
    absolute = true            # the light of the scene as it is, instead of ppp
    seed = 1                   # of the noise; default: that of [recipe]
    name = "dim"               # of the stream; default: made from sensor, bits and light
    group = true               # a code sums 2^bits - 1 clip frames as binary planes; default false
    follow = true              # a counting SPAD is drawn photon by photon, so that their times are known; default false
    slices = 16                # clip frames in one exposure of a QIS or a counting SPAD; default 1
    diffraction = true         # blur by the lens's Airy pattern; default false
    row_delay = 2e-6           # seconds from one row, or column, to the next; default: all at once
    row_order = "down"         # order of rows: down, the default, or up; of columns: right or left
    exposures = [1.0, 0.25]    # shares of a code's time with light, in turn; default: all of it
    colour = "rggb"            # colour filters: rggb, quad, rgbw or a .toml with [colour]; default: the sensor's
    temperature = 25.0         # degrees C, by a law of the sensor file (dark_doubling); default: that of the file

A (family, seed) belongs to one split at every speed, and a family of the test split to no other split.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qsim import checks, files
from qsim.clip.clip_folder import ClipFolder
from qsim.clip.clip_info import ClipInfo
from qsim.dataset.job import FRAME_RATE, Job, Settings
from qsim.dataset.recipe_sections.scenes_section import SETTINGS, jobs_of, settings_of
from qsim.dataset.recipe_sections.streams_section import streams_of
from qsim.dataset.recipe_sections.toml_section import Section, Text, file_name
from qsim.optics.radiometry import RGB
from qsim.streams.sensing import Sensing, filters_of, prepare
from qsim.structure import Table

SPLITS = checks.SPLITS


@dataclass(frozen=True)
class Recipe:
    """Description of a data set: its name and jobs."""

    name: str
    jobs: tuple[Job, ...]
    source: dict[str, Any]  # the TOML file's content, as written

    @property
    def splits(self) -> dict[str, list[str]]:
        """Return the names of the clips of each split."""
        return {split: [job.name for job in self.jobs if job.split == split] for split in SPLITS}

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the jobs' digests: equal for equal jobs in equal order."""
        return files.sha256(files.to_json([job.digest for job in self.jobs]))


def load(path: str | Path) -> Recipe:
    """Read a recipe, a file or the name of a shipped one; errors as `text_of`, or `FILE:LINE: error, remedy`."""
    found, text = text_of(path)
    return parse(text, found)


def text_of(path: str | Path) -> tuple[Path, str]:
    """Return the file of a recipe, also of the name of a shipped one, and its text.

    `FileNotFoundError`, or `ValueError` for a file that is not text.
    """
    from qsim.scenes import FAMILIES, RECIPES

    found = Path(path)
    if not found.is_file():
        if str(path) in FAMILIES:
            raise FileNotFoundError(f"{path}: is a scene family, not a recipe; use `qsim render {path}`")
        if str(path) not in RECIPES:
            known = ", ".join(RECIPES)
            raise FileNotFoundError(
                f"{path}: no such recipe{checks.suggest(str(path), RECIPES)}; give a .toml file, or one of {known}"
            )
        found = RECIPES[str(path)]
    try:
        return found, found.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; a recipe is TOML in UTF-8") from None


def parse(text: str, path: Path = Path("recipe.toml")) -> Recipe:
    """Return the recipe in the text of a TOML file; errors name `path`, and relative files are beside it."""
    written = Text(path, text)
    document = Section(written, None, 0, written.content())
    document.values({"recipe, if any": _kept, "scenes, if any": _kept, "streams, if any": _kept})
    if not isinstance(document.table.get("recipe"), dict):
        raise ValueError(f"{path}: the section [recipe] is missing")
    head = Section(written, "recipe", 0, document.table["recipe"])
    given = head.values(HEAD)
    name = given["name"]
    seed = given.get("seed", 0)
    defaults = {"frame_rate": FRAME_RATE} | settings_of(head, given)
    streams: list[Sensing] = []
    taken: set[str] = set()
    for section in document.sections("streams"):
        streams += streams_of(section, seed, taken)
    jobs: list[tuple[Job, Section]] = []
    for section in document.sections("scenes"):
        jobs += [(job, section) for job in jobs_of(section, defaults, seed, tuple(streams))]
    _check_jobs(jobs, path)
    return Recipe(name, tuple(job for job, _ in jobs), document.table)


def _check_jobs(jobs: list[tuple[Job, Section]], path: Path) -> None:
    """`ValueError` without jobs, for a clip listed twice, or a split that shares a scene.

    A scene may be in one split only, and a family of the test split in no other split.
    """
    if not jobs:
        raise ValueError(f"{path}: no [[scenes]], nothing to render")
    seen: set[str] = set()
    split_of: dict[str, str] = {}
    tested = {job.stem for job, _ in jobs if job.split == "test"}
    for job, section in jobs:
        if job.name in seen:
            raise ValueError(f"{section.where()}: the clip {job.name} is listed twice; give one of them other seeds")
        seen.add(job.name)
        same = job.family.endswith(".xml")  # the seed of such a scene changes its samples only
        scene = job.stem if same else job.scene
        if split_of.setdefault(scene, job.split) != job.split:
            cure = "an .xml scene is the same scene at every seed: leave one of them out"
            raise ValueError(
                f"{section.where()}: scene {scene} is in the splits '{split_of[scene]}' and '{job.split}'; "
                + (cure if same else "splits are by scene, at any speed: give one of them other seeds")
            )
        if job.split != "test" and job.stem in tested:
            where = f"{section.where()}: family {job.stem} is in the splits '{job.split}' and 'test'"
            raise ValueError(f"{where}; the test split holds families that training never sees: move its scenes")
    _check_streams(jobs)


def _check_streams(jobs: list[tuple[Job, Section]]) -> None:
    """`ValueError` with the line of [[scenes]] for clips whose streams could not be drawn after rendering."""
    seen = set()
    for job, section in jobs:
        own = job.family.endswith(".py")  # no other scene may state bands
        case = (job.settings, own)
        if case in seen:
            continue
        seen.add(case)
        for sensing in job.streams:
            with section.naming():
                colour = job.settings.bands is not None or (own and filters_of(sensing) is not None)
                clip = _unrendered(sensing.stream_name, job.settings, colour)
                prepare(clip, replace(sensing, ppp=1.0, lux=None))


def _unrendered(name: str, settings: Settings, colour: bool) -> ClipFolder:
    """Return a clip of mean light 1 without frames, for the checks of sensing."""
    info = ClipInfo(
        name=name,
        shape=(settings.frames, settings.height, settings.width),
        frame_rate=settings.frame_rate,
        exposure=(settings.shutter or 1.0) / settings.frame_rate,
        mean_radiance=1.0,
        bands=RGB if colour else None,
    )
    return ClipFolder(Path(name), info)


def _kept(value: Any) -> Any:
    """Return the value: sections are checked one by one."""
    return value


HEAD: Table = {
    "name": file_name,
    "seed, if any": checks.seed,
    **{key if key in ("frames", "height", "width") else f"{key}, if any": check for key, check in SETTINGS.items()},
}
