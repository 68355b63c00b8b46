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

    [[scenes]]                 # one clip per family, seed and speed
    family = "fan"             # a family of scenes/; or a .py file, .xml file or folder beside the recipe ("./things")
    seeds = [0, 1, 2]          # one clip each; or give count
    count = 3                  # clips of the seeds first ... first + count - 1
    first = 0                  # first seed of a count; default 0
    speed = [1.0, 2.0]         # factor on all motions, a number or a list; default 1
    split = "train"            # train, the default, val or test
    # frames, height, width, frame_rate, shutter, psnr, bands: as above, for these scenes only

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

A (family, seed) belongs to one split at every speed, and a family of the test split to no other split.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.checks import MAX_PIXELS
from qsim.clip.rows import Rows
from qsim.clip.sensing import Sensing
from qsim.dataset.job import Job, Settings
from qsim.dataset.recipe_toml import Section, Text
from qsim.files import check_name
from qsim.structure import Check, Table

SPLITS = checks.SPLITS
MAX_STEM = 180  # characters of a scene's name, which gets a seed, a speed and a temporary ending as a file's name


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


def load(path: str | Path) -> Recipe:
    """Read a recipe, a file or the name of a shipped one; errors as `text_of`, or `FILE:LINE: error, remedy`."""
    found, text = text_of(path)
    return parse(text, found)


def text_of(path: str | Path) -> tuple[Path, str]:
    """Return the file of a recipe, also of the name of a shipped one, and its text.

    `FileNotFoundError`, or `ValueError` for a file that is not text.
    """
    from qsim.scenes import RECIPES

    found = Path(path)
    if not found.is_file():
        if str(path) not in RECIPES:
            known = ", ".join(RECIPES)
            raise FileNotFoundError(
                f"{path}: no such recipe{checks.suggest(str(path), RECIPES)}; give a .toml file, or one of {known}"
            )
        found = RECIPES[str(path)]
    try:
        return found, found.read_text(encoding="utf-8")
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
    name, seed = given["name"], given.get("seed", 0)
    defaults = {"frame_rate": 2000.0} | _settings(given)
    streams: list[Sensing] = []
    taken: set[str] = set()
    for section in document.sections("streams"):
        streams += _streams(section, seed, taken)
    jobs: list[tuple[Job, Section]] = []
    for section in document.sections("scenes"):
        jobs += [(job, section) for job in _jobs(section, defaults, seed, tuple(streams))]
    _check_jobs(jobs, path)
    return Recipe(name, tuple(job for job, _ in jobs), document.table)


def _check_jobs(jobs: list[tuple[Job, Section]], path: Path) -> None:
    """`ValueError` without jobs, for a clip listed twice, a split that shares a scene, or too few frames for a sum.

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
        for sensing in job.streams:
            if sensing.colour is not None and job.settings.bands is None and job.family == job.stem:
                raise ValueError(f"{section.where()}: one band, but {sensing.stream_name} has filters; give bands")
            if sensing.rows is not None:
                with section.naming():
                    at = job.settings
                    sensing.rows.check(at.height, at.width, at.frame_rate, sensing.slices, sensing.stream_name)
            taken = 2 ** (sensing.bits or 1) - 1 if sensing.group else sensing.slices
            if job.settings.frames < taken:
                few = f"{job.settings.frames} frames are too few for {sensing.stream_name}, whose codes sum"
                cure = f"{taken} of them; render more frames, or use fewer bits or slices"
                raise ValueError(f"{section.where()}: {few} {cure}")


def _jobs(section: Section, defaults: dict[str, Any], seed: int, streams: tuple[Sensing, ...]) -> list[Job]:
    """Return one job per seed and speed of a [[scenes]] section."""
    given = section.values(SCENES)
    family = _family(section, given["family"])
    seeds = _seeds(section, given)
    speeds = given.get("speed", [1.0])
    if family.endswith(".xml") and speeds != [1.0]:
        why = "an .xml scene has no motion, so speed changes nothing; leave it out"
        raise ValueError(f"{section.where('speed')}: {why}")
    split = given.get("split", "train")
    settings = Settings(**(defaults | _settings(given)))
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


def _settings(given: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `Settings` that a section gives."""
    return {key: given[key] for key in _SETTINGS if key in given}


def _family(section: Section, family: str) -> str:
    """Return a family of the library, or the absolute path of an existing scene file or folder."""
    file = (section.text.path.parent / family).resolve()
    if "/" in family and file.is_dir():
        return str(file)
    if family.endswith((".py", ".xml")):
        if not file.is_file():
            raise ValueError(f"{section.where('family')}: no such scene file {file}")
        return str(file)
    from qsim.scenes import FAMILIES

    if family not in FAMILIES:
        meant = f"{family!r}{checks.suggest(family, FAMILIES)}; there are: {', '.join(sorted(FAMILIES))}"
        raise ValueError(f"{section.where('family')}: unknown family {meant}")
    return family


def _seeds(section: Section, given: dict[str, Any]) -> list[int]:
    """Return the seeds of a section, listed or counted."""
    if "seeds" in given:
        if other := next((key for key in ("count", "first") if key in given), None):
            raise ValueError(f"{section.where(other)}: give either seeds or count, not both")
        return list(given["seeds"])
    first, count = given.get("first", 0), given.get("count", 1)
    if first + count > 2**31:
        key = "count" if "count" in given else "first"
        raise ValueError(f"{section.where(key)}: seeds {first} to {first + count - 1}; the largest is 2^31 - 1")
    return list(range(first, first + count))


def _streams(section: Section, seed: int, taken: set[str]) -> list[Sensing]:
    """Return one stream per bits and light level, and add their names to `taken`; `ValueError` for a taken name."""
    given = section.values(STREAMS)
    levels = _light(section, given)
    bits, name = given.get("bits", [None]), given.get("name")
    sensor = _sensor(section, given["sensor"], bits, given.get("group", False), given.get("slices", 1))
    with section.naming("row_order"):
        rows = Rows.of(given.get("row_delay"), given.get("row_order"))
    if name is not None and (count := len(bits) * len(levels)) > 1:
        cure = "give one bits and one light level, or leave the name out"
        raise ValueError(f"{section.where('name')}: one name for {count} streams; {cure}")
    found = [
        Sensing(
            sensor,
            bits=b,
            name=name,
            colour=_colour(section, given.get("colour")),
            seed=given.get("seed", seed),
            group=given.get("group", False),
            diffraction=given.get("diffraction", False),
            slices=given.get("slices", 1),
            follow=given.get("follow", False),
            rows=rows,
            exposures=given.get("exposures"),
            **light,
        )
        for b in bits
        for light in levels
    ]
    for sensing in found:
        with section.naming("sensor", "streams are named after the sensor: "):
            stream = sensing.stream_name
        if stream in taken:
            raise ValueError(f"{section.where()}: two [[streams]] are called '{stream}'; give one of them a name")
        taken.add(stream)
    return found


def _light(section: Section, given: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the fields of `Sensing` that state each light level; absolute light has none."""
    units = [key for key in ("ppp", "lux", "absolute") if key in given]
    if len(units) != 1:
        wanted = "give one light level, ppp = ..., lux = ... or absolute = true"
        raise ValueError(f"{section.where()}: {wanted}; {' and '.join(units) or 'none'} given")
    unit = units[0]
    if unit != "absolute":
        return [{unit: level} for level in given[unit]]
    if not given["absolute"]:
        raise ValueError(f"{section.where('absolute')}: absolute can only be true; or give a ppp")
    return [{}]


def _sensor(section: Section, sensor: str, bits: list[int | None], group: bool, slices: int) -> str:
    """Return the sensor's name or absolute file; `ValueError` if it lacks these bits, or cannot be read as asked."""
    from qsim.sensor import QIS, BinarySPAD, CountingSPAD, devices

    if sensor.endswith(".toml"):
        sensor = str((section.text.path.parent / sensor).resolve())
    for depth in bits:
        with section.naming("sensor"):
            found = devices.load(sensor, ppp=3.25, bits=depth, exposure=5e-4)
        if group and not (depth and isinstance(found, BinarySPAD)):
            what = f"this is a {type(found).__name__}" if depth else "the bits of a code are needed, as in bits = 3"
            raise ValueError(f"{section.where('group')}: group sums planes of a clocked SPAD; {what}")
        if slices > 1 and (group or not isinstance(found, QIS | CountingSPAD)):
            what = "group sums planes instead" if group else f"this is a {type(found).__name__}"
            raise ValueError(f"{section.where('slices')}: slices are of one exposure of a QIS or CountingSPAD; {what}")
    return sensor


def _colour(section: Section, colour: str | None) -> str | None:
    """Return the name or absolute file of colour filters; `ValueError` if they cannot be read."""
    from qsim.sensor import colour_filter

    if colour is not None:
        colour = str((section.text.path.parent / colour).resolve()) if colour.endswith(".toml") else colour
        with section.naming("colour"):
            colour_filter.load(colour)
    return colour


def _name(value: Any) -> str:
    """Return a text that can name a file."""
    return check_name(checks.text(value))


def _kept(value: Any) -> Any:
    """Return the value: sections are checked one by one."""
    return value


_SETTINGS: dict[str, Check] = {
    "frames": checks.whole, "height": checks.whole, "width": checks.whole,
    "frame_rate": checks.frame_rate, "shutter": checks.shutter, "psnr": checks.psnr,
    "bands": checks.bands,
}  # fmt: skip
HEAD: Table = {
    "name": _name,
    "seed, if any": checks.seed,
    **{key if key in ("frames", "height", "width") else f"{key}, if any": check for key, check in _SETTINGS.items()},
}
SCENES: Table = {
    "family": checks.text,
    "seeds, if any": checks.list_of(checks.seed), "count, if any": checks.whole, "first, if any": checks.seed,
    "speed, if any": checks.list_of(checks.speed), "split, if any": checks.split,
    **{f"{key}, if any": check for key, check in _SETTINGS.items()},
}  # fmt: skip
STREAMS: Table = {
    "sensor": checks.text, "bits, if any": checks.list_of(checks.bits),
    "ppp, if any": checks.list_of(checks.light), "lux, if any": checks.list_of(checks.light),
    "absolute, if any": checks.flag, "follow, if any": checks.flag,
    "seed, if any": checks.seed, "name, if any": _name,
    "group, if any": checks.flag, "slices, if any": checks.whole, "diffraction, if any": checks.flag,
    "row_delay, if any": checks.positive, "row_order, if any": checks.row_order,
    "colour, if any": checks.text, "exposures, if any": checks.shares,
}  # fmt: skip
