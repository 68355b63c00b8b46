"""Draws training windows from the clips of a data set: a plain `torch` data set, usable without our loop.

    clip -> photons of a window and its sharp truth -> codes, drawn when read -> codes/(2^b - 1), photons/white

Sample n is a function of (seed, n) alone: its clip, place, turn, light level and every bit of its noise. So 0, 1 or 8
workers give the same bytes, and a killed run resumes with the next sample. Sample n + e * len(windows) is sample n of
epoch e, with new noise; `Batches` counts on from epoch to epoch, a loader without it repeats epoch 0, noise included.
Dr.Jit, which does not survive a fork, is not used. Sensor, light and defects are those of the clips' streams unless the
settings name others (noise.py). Dead and hot pixels are filled as before restoration.

    data = windows("out/starter", split="train", crop=64)
    loader = DataLoader(data, batch_sampler=Batches(8, first=0, last=1000))
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy import ndarray as Array
from torch.utils.data import Dataset, Sampler

from qsim.dataset.clip_list import ClipList
from qsim.keys import Key
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.demosaicing import determines_bands
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.code_truth import CodeTruth
from qsim.streams.exposures import Timing
from qsim.streams.simulation import Draw
from qsim.streams.stream import Stream
from quiver.data.clips import has_sharp, open_clips, peak_of
from quiver.data.code_table import draw_codes
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.data.mixture import Mixture, choose
from quiver.data.mosaic_windows import TURNS, fitting_turns, place_in_tile, turned_frame
from quiver.data.window_noise import (
    WindowLight,
    WindowPlace,
    behind_defects,
    check_slices,
    check_windows,
    filled_window,
)
from quiver.host import own_numbers

# Computes inputs of a network from the codes of a window: name -> tensor, each the same shape for all windows. It runs
# where samples are drawn, in worker processes too, and gets no gradients; it is a function of a module, not a lambda.
Prepare = Callable[[Codes, int], Mapping[str, torch.Tensor]]  # (codes of a window, its number)

# stages of the random keys: no two uses share noise (0 is `qsim sense`)
TRAINING = 1
VALIDATION = 2
STILL = 3
SHUFFLED = 1 << 16  # numbers of an epoch that are shuffled together
DARKEST = 1e-9  # photons, least mean of a window that is brought to a light level
POOLED = 5  # a part of seeds
STAY = 256  # samples after which a pool takes one more clip, and loses one
KEPT = 256  # clips that stay open, with what draws their codes
# Turns that keep the direction in which rows (0) or columns (1) are read: none, and mirrored along them
TURNS_OF_ROWS = ((0, 4), (0, 6))


@dataclass(frozen=True)
class WindowSettings:
    """The settings of training samples."""

    lights: tuple[Illumination, ...] | None = None  # each sample draws one; None: those of the clips' streams
    frames: int = 11
    least: int = 1  # frames that the network needs, for advice
    crop: int = 64  # px, side of the square; validation takes the centre
    flips: bool = True  # the eight flips and quarter turns
    reverse: bool = True  # half of the windows run backwards in time
    drift: int = 0  # px/frame; in half of the windows the crop moves, up to this far along each side
    force_exposure: bool = False  # published: every window is brought to the light level separately
    pool: int | None = None  # clips that windows are drawn from at a time; None: all
    still: bool = False  # items also hold noisy copies of the centre frame, drawn without defects
    ceiling: float = 2.0  # of targets, in units of white, or the peak of the scores where that is more
    seed: int = 0

    def __post_init__(self) -> None:
        if self.frames < 1 or self.crop < 1:
            raise ValueError(f"WindowSettings: frames and crop must be at least 1, got {self.frames} and {self.crop}")
        if self.pool is not None and self.pool < 1:
            raise ValueError(f"WindowSettings: pool must be at least 1, got {self.pool}")
        if self.lights is not None and not self.lights:
            raise ValueError("WindowSettings.lights is empty; give at least one light level, or None for the streams'")


class Windows(Dataset[dict[str, Any]]):
    """Windows of `frames` frames from the clips of a folder: a `torch` data set.

    Numbers from `len` on are windows, too: those of the next epochs, with new noise. An item holds:

        codes    float32 [T, 1, h, w] in [0, 1]
        target   float32 [T, 1, h, w], of mosaics [T, 3, h, w]: sharp photons / white, up to `ceiling` or the peak
        white    photons
        peak     photons, of its scores
        ppp      mean photons per pixel and exposure, of a mosaic those behind its filters
        sample   its number
        key      text: clip, place, light, random key
        still    float32 [T, 1, h, w] in [0, 1], codes of a scene that rests as in the centre frame, if asked for
        shares   float32 [T], exposure of each code over a full one, of sensors whose exposures take turns
        ...      what `prepare` returns for the codes, their sensor, exposure and light

    Codes and target follow the sensor of their window. `noise` is the mixture that windows draw from; `repr` shows it.
    Clips of three bands give mosaics: all noises have the same colour filters, whose mask begins at the first pixel of
    each window (mosaic_windows.py). `ValueError` for a folder without clips, for clips shorter or smaller than a
    window, and for noise that windows cannot have.
    """

    def __init__(
        self,
        clips: Sequence[Clip],
        settings: WindowSettings,
        *,
        fixed: bool = False,
        repeats: int = 1,
        prepare: Prepare | None = None,
    ) -> None:
        """Choose the noise. An epoch holds `repeats` windows of every clip.

        `fixed` is for validation: one window per clip and light level, from the middle of the clip, not turned, equal
        in every epoch.
        """
        self.clips = ClipList.of(clips)
        alike = self.clips.alike()
        check_clips(alike, settings)
        self.settings = settings
        self.fixed = fixed
        self.prepare = prepare
        if settings.lights is None:
            self.noise = choose(self.clips)
        else:
            self.noise = Mixture(tuple(light.stated() for light in settings.lights))
        self.filters = _filters_of_all(alike, self.noise.noises, settings)
        for noise in self.noise.noises:
            _check_codes(alike, noise, settings)
        # One clip of each kind is checked, as clips of a data set are thousands and mostly alike.
        lit = {clip.camera is None: clip for clip in reversed(alike)}  # of clips that are alike the first
        sized = {(clip.camera is None, clip.shape[1:], clip.origin): clip for clip in reversed(alike)}  # for defects
        for noise in self.noise.noises:
            for clip in (lit if noise.defects is None else sized).values():
                check_windows(noise, clip)
                if prepare is not None:  # from the response, which some sensors do not have
                    noise.draw(clip).sensor.response(clip.exposure * noise.planes, points=2)
            for clip in alike:
                check_slices(noise, clip)
        self.length = len(self.clips) * (len(self.noise.noises) if fixed else repeats)
        self._draws: dict[tuple[int, int], tuple[Draw, Array | None, Sensor]] = {}  # of the clips that were used last
        self._opened: dict[int, Clip] = {}  # the same

    def __repr__(self) -> str:
        return f"<Windows of {len(self.clips)} clips; {'; '.join(self.noise.lines)}>"

    def __len__(self) -> int:
        return self.length

    def place(self, n: int) -> WindowPlace:
        """Return where sample n lies, without reading it."""
        if self.fixed:
            return self._middle(n % self.length)
        settings = self.settings
        epoch, index = divmod(n, self.length)
        clip = self.clip_of(n)
        rng = np.random.default_rng((settings.seed, epoch, index))
        length, height, width = self.clip(clip).shape
        frame = int(rng.integers(length - settings.frames + 1))
        drift = self._drift(clip, rng)
        # A crop that drifts up or left begins with that much room on this side.
        y, x = (
            int(rng.integers(side - settings.crop - abs(way) + 1)) + max(0, -way)
            for side, way in zip((height, width), (d * (settings.frames - 1) for d in drift), strict=True)
        )
        light = int(rng.integers(len(self.noise.noises)))
        turn = int(rng.integers(8)) if settings.flips else 0
        backwards = bool(rng.integers(2)) if settings.reverse else False
        timing = self.noise.noises[light].timing
        codes = len(timing.over(self.clip(clip)))
        if timing.rows is not None:
            turn = TURNS_OF_ROWS[timing.rows.axis][turn % 2]
        turn, y, x = self._in_tile(clip, light, turn, y, x, drift)
        return WindowPlace(
            clip=clip,
            start=frame * (codes - settings.frames + 1) // (length - settings.frames + 1),
            y=y,
            x=x,
            drift=drift,
            light=light,
            turn=turn,
            backwards=backwards and timing.rows is None,
            key=Key(seed=settings.seed, clip=n, stage=TRAINING),
        )

    def clip_of(self, n: int) -> int:
        """Return the number of the clip that sample n draws."""
        if self.settings.pool is not None:
            return self.clip_at(self.position_of(n))
        epoch, index = divmod(n, self.length)
        return shuffled(self.length, (self.settings.seed, epoch), index) % len(self.clips)

    def position_of(self, n: int) -> int:
        """Return which clip of the endless row of `clip_at` sample n draws: one of the `pool` that are in turn.

        After STAY samples the first one of them leaves, and the next one comes.
        """
        assert self.settings.pool is not None
        rng = np.random.default_rng((self.settings.seed, n, POOLED))
        return n // STAY + int(rng.integers(self.settings.pool))

    def clip_at(self, position: int) -> int:
        """Return the number of a clip in an endless row: all clips in random order, then all in another."""
        epoch, index = divmod(position, len(self.clips))
        return shuffled(len(self.clips), (self.settings.seed, epoch), index)

    def _drift(self, clip: int, rng: np.random.Generator) -> tuple[int, int]:
        """Return the drift of the crop [px/frame], limited by the size of the clip."""
        settings = self.settings
        if not settings.drift or rng.random() < 0.5:
            return 0, 0
        kept = (0, 0) if self.filters is None else [period - 1 for period in self.filters.tile]  # to place the mask
        sides = self.clip(clip).shape[1:]
        room = [
            max(0, side - settings.crop - most) // max(1, settings.frames - 1)
            for side, most in zip(sides, kept, strict=True)
        ]
        dy, dx = (int(rng.integers(-most, most + 1)) for most in (min(settings.drift, r) for r in room))
        if self.filters is None:
            return dy, dx
        rows, columns = self.filters.tile  # by full tiles: the filters stay in place
        return int(dy / rows) * rows, int(dx / columns) * columns

    def _in_tile(
        self, number: int, light: int, turn: int, y: int, x: int, drift: tuple[int, int] = (0, 0)
    ) -> tuple[int, int, int]:
        """Return a turn and a place of a window at which its mask begins; the same without colour filters."""
        if self.filters is None:
            return turn, y, x
        clip = self.clip(number)
        fitting = _turns_of_mosaic(self.filters, clip, self.noise.noises[light], self.settings)
        turn = turn if turn in fitting else sorted(fitting)[turn % len(fitting)]
        rows, columns = self.filters.tile
        back = [max(0, -step * (self.settings.frames - 1)) for step in drift]
        # A drift to lower rows ends before its start: the place of the mask counts from the crop's least row.
        y = back[0] + place_in_tile(y - back[0], fitting[turn][0] - back[0], rows)
        x = back[1] + place_in_tile(x - back[1], fitting[turn][1] - back[1], columns)
        return turn, y, x

    def _middle(self, index: int) -> WindowPlace:
        settings = self.settings
        clip = index % len(self.clips)
        _, height, width = self.clip(clip).shape
        light = index // len(self.clips)
        start = (len(self.noise.noises[light].timing.over(self.clip(clip))) - settings.frames) // 2
        y = (height - settings.crop) // 2
        x = (width - settings.crop) // 2
        key = Key(seed=settings.seed, clip=index, stage=VALIDATION)
        turn, y, x = self._in_tile(clip, light, 0, y, x)
        return WindowPlace(clip, start, y, x, (0, 0), light, turn, False, key)

    def clip(self, number: int) -> Clip:
        """Return the opened clip of a number; those that were used last stay open."""
        if number not in self._opened:
            keep_last(self._opened, KEPT - 1)
            self._opened[number] = self.clips[number]
        return self._opened[number]

    def spread(self, count: int) -> list[int]:
        """Return the numbers of at most `count` fixed windows, spread over the clips and over the light levels."""
        if self.length <= count:
            return list(range(self.length))
        clips = len(self.clips)
        lights = len(self.noise.noises)
        order = np.random.default_rng(0).permutation(clips)  # so that the light does not follow the order of clips
        return [n * lights // count * clips + int(order[n % clips]) for n in range(count)]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield the windows of the first epoch."""
        return (self[n] for n in range(len(self)))

    @own_numbers
    def __getitem__(self, n: int) -> dict[str, Any]:
        place = self.place(n)
        clip = self.clip(place.clip)
        noise = self.noise.noises[place.light]
        settings = self.settings
        draw, bad, behind = self._draw(place)
        exposure = clip.exposure * draw.planes
        level = draw.level.ppp * draw.planes
        light = WindowLight.of(noise, draw, clip, place, settings.frames, settings.crop)
        photons = self._turned(light.exposed(), place)
        sharp = self._sharp(place, photons)
        scale = 1.0
        if settings.force_exposure and noise.ppp is not None:
            # As published: every window is exposed to the light level by its own mean, not by that of its clip.
            scale = noise.ppp / max(float((photons if self.filters is None else sharp).mean()), DARKEST)
        try:
            if noise.defects is None and draw.timing == Timing():  # any pixel of the sensor, in its own random numbers
                codes = draw_codes(draw.sensor, photons * scale, exposure, place.key)
            else:
                tile = (1, 1) if self.filters is None else self.filters.tile
                codes = self._turned(filled_window(light.drawn(scale), bad, place, behind, tile), place)
        except ValueError as error:
            raise ValueError(f"{clip.path}: window from code {place.start}: {error}") from None
        white = draw.sensor.white(exposure)
        peak = white if settings.force_exposure else peak_of(level)
        target = np.minimum(sharp / white, max(settings.ceiling, peak / white))  # a SPAD tells light above 2 white
        sample = {
            "codes": as_input(codes, draw.sensor),
            "target": torch.from_numpy(target.astype(np.float32).reshape(len(codes), -1, *codes.shape[1:])),
            "white": white,
            "peak": peak,
            "ppp": float((photons * scale).mean()),
            "sample": n,
            "key": self.text_of(place),
        }
        shares = None
        if draw.timing.shares is not None:
            shares = tuple(draw.timing.share(t) for t in light.codes[light.lead :])
            sample["shares"] = torch.tensor(shares, dtype=torch.float32)
        if settings.still:
            resting = np.broadcast_to(self._at_rest(place) * scale, photons.shape)
            key = replace(place.key, stage=STILL + place.key.stage)
            sample["still"] = as_input(draw_codes(behind, resting, exposure, key), draw.sensor)
        if self.prepare is None:
            return sample
        seen = array_codes(codes, behind, exposure, name=clip.name)
        return sample | dict(self.prepare(replace(seen, ppp=level, shares=shares, colour=self.filters), n))

    def seen_by(self, place: WindowPlace) -> tuple[Sensor, float]:
        """Return the sensor of the filled codes of a window, and their exposure [s]."""
        draw, _, behind = self._draw(place)
        return behind, self.clip(place.clip).exposure * draw.planes

    def bad_of(self, place: WindowPlace) -> Array | None:
        """Return the dead and hot pixels of a window, bool [h, w], not turned; None where its noise has no defects."""
        _, bad, _ = self._draw(place)
        if bad is None:
            return None
        return bad[place.y : place.y + self.settings.crop, place.x : place.x + self.settings.crop]

    def text_of(self, place: WindowPlace) -> str:
        """Return the text `key` of a window."""
        return (
            f"{self.clip(place.clip).name} frame {place.start}, (y, x) ({place.y}, {place.x}), turn {place.turn}, "
            f"{'backwards, ' if place.backwards else ''}{self.noise.noises[place.light].label}, {place.key}"
        )

    def photons_of(self, place: WindowPlace) -> tuple[Array, Array]:
        """Return the expected photons of the exposed and of the sharp window, float64 [T, h, w] each, turned.

        Of a mosaic the first are those behind its filters, and the second have three bands: [T, 3, h, w].
        """
        clip = self.clip(place.clip)
        draw, _, _ = self._draw(place)
        settings = self.settings
        light = WindowLight.of(self.noise.noises[place.light], draw, clip, place, settings.frames, settings.crop)
        exposed = self._turned(light.exposed(), place)
        return exposed, self._sharp(place, exposed)

    def _turned(self, window: Array, place: WindowPlace) -> Array:
        """Return a window [T, h, w], which is in the order of its exposure, turned as its place states."""
        return turned(window, replace(place, backwards=False))

    def _sharp(self, place: WindowPlace, exposed: Array) -> Array:
        """Return the sharp photons [T, h, w] of a window, turned; those that are exposed where a clip has no others.

        Of clips of three bands they are [T, 3, h, w].
        """
        clip = self.clip(place.clip)
        draw, _, _ = self._draw(place)
        if self.filters is None and draw.timing == Timing() and not (has_sharp(clip) or draw.diffraction):
            return exposed
        truth = CodeTruth(clip, draw.timing, draw.level.factor)
        return turned(np.stack([self._sharp_code(truth, place, i) for i in range(self.settings.frames)]), place)

    def _sharp_code(self, truth: CodeTruth, place: WindowPlace, i: int) -> Array:
        """Return the sharp photons [h, w] or [3, h, w] of code i of a window, not turned."""
        dy, dx = place.drift
        side = self.settings.crop
        return truth.sharp(place.start + i, (place.y, place.x, side, side), moved=(dy * i, dx * i))

    def _at_rest(self, place: WindowPlace) -> Array:
        """Return the photons [h, w] of the centre code, turned, of a scene that rests there: without motion blur."""
        clip = self.clip(place.clip)
        frames = self.settings.frames
        draw, _, _ = self._draw(place)
        i = frames - 1 - frames // 2 if place.backwards else frames // 2
        truth = CodeTruth(clip, draw.timing, draw.level.factor, draw.diffraction)
        return turned(self._sharp_code(truth, place, i)[None], place)[0]

    def _draw(self, place: WindowPlace) -> tuple[Draw, Array | None, Sensor]:
        """Return what draws the codes of a place's clip and noise, its defective pixels, and the sensor behind them."""
        if (place.clip, place.light) not in self._draws:
            keep_last(self._draws, KEPT - 1)
            noise = self.noise.noises[place.light]
            clip = self.clip(place.clip)
            draw = noise.draw(clip)
            self._draws[place.clip, place.light] = draw, *behind_defects(noise, draw, clip)
        return self._draws[place.clip, place.light]


@own_numbers
def windows(
    source: Clip | Stream | Sequence[Clip] | str | os.PathLike[str],
    *,
    split: str | None = None,
    frames: int = 11,
    crop: int = 64,
    planes: int | None = None,
    seed: int = 0,
    repeats: int = 1,
) -> Windows:
    """Return training windows for a `torch.utils.data.DataLoader`: codes, truth and light. Each number has its noise.

    `source` is a stream (its sensor and light), a clip, some clips, or the folder of a clip or a data set, of which
    `split` names a part (train, val, test). A window has `frames` codes of `crop` x `crop` px, each over `planes` clip
    frames, by default as many as in the streams; an epoch holds `repeats` windows of every clip, and `Batches` gives a
    loader the numbers of all epochs. `Windows` states the items; `WindowSettings` has more settings. `ValueError` where
    no window fits.
    """
    settings = WindowSettings(frames=frames, crop=crop, seed=seed)
    if isinstance(source, str | os.PathLike):
        clips: Sequence[Clip] = open_clips(os.fspath(source), split)
    elif split is not None:
        raise ValueError("split= is for the folder of a data set; leave it out")
    elif isinstance(source, Stream):
        folder = source.clip
        clips = [Clip(folder.path, folder.info, folder.keeps)]
        settings = replace(settings, lights=(Illumination.of_stream(source),))
        if planes is not None:
            raise ValueError(f"planes= is for clips, and stream {source.name} has its own; leave it out")
    else:
        clips = [source] if isinstance(source, Clip) else source
    if planes is not None:
        settings = replace(settings, lights=choose(clips, planes=planes).noises)
    return Windows(clips, settings, repeats=repeats)


@lru_cache(maxsize=4)
def _order(count: int, seed: tuple[int, ...]) -> Array:
    return np.random.default_rng(seed).permutation(count)


def shuffled(length: int, seed: tuple[int, int], index: int) -> int:
    """Return number `index` of the shuffled numbers 0 ... length - 1, in memory that does not grow with the length.

    Each `SHUFFLED` of them are shuffled together: those with the same remainder, so that they are spread over all.
    """
    parts = -(-length // SHUFFLED)
    if parts == 1:
        return int(_order(length, seed)[index])
    # The first `longer` parts have one number more; each part is shuffled alone and interleaved with the others.
    least, longer = divmod(length, parts)
    part = min(index // (least + 1), longer)
    if part == longer:
        part += (index - longer * (least + 1)) // least
    start = part * least + min(part, longer)
    return int(_order(least + (part < longer), (*seed, part))[index - start]) * parts + part


def keep_last(kept: dict[Any, Any], count: int) -> None:
    """Leave at most `count` entries of a dictionary, those that were added last."""
    while len(kept) > count:
        del kept[next(iter(kept))]


def turned(window: Array, place: WindowPlace) -> Array:
    """Return a window [T, ..., h, w] flipped, turned and reversed as its place states."""
    window = turned_frame(window, place.turn)
    return np.ascontiguousarray(window[::-1] if place.backwards else window)


def as_input(codes: Array, sensor: Sensor) -> torch.Tensor:
    """Return codes [T, H, W] as the input of networks: float32 [T, 1, H, W], codes / (2^b - 1)."""
    return torch.from_numpy(codes.astype(np.float32) / np.float32(sensor.levels - 1))[:, None]


def _filters_of_all(
    clips: Sequence[Clip], noises: Sequence[Illumination], settings: WindowSettings
) -> ColourFilter | None:
    """Return the colour filters of all noises, None without any.

    `ValueError` if they differ, do not determine three bands, or leave no place for a window in a clip.
    """
    for clip in clips:
        if clip.bands is not None and not all(noise.colour for noise in noises):
            raise ValueError(
                f"{clip.name}: has three bands, and the noise of its windows no colour filters; sense a stream with "
                "colour=rggb, whose filters they take, or give sensor= with a file that has a table [colour]"
            )
    found = {noise.colour: noise for noise in noises}
    if len(found) > 1:
        masks = [" ".join(noise.filters.mask) if noise.filters else "none" for noise in found.values()]
        raise ValueError(f"windows have one mask of colour filters, these noises {'; '.join(masks)}; choose one")
    noise = noises[0]
    filters = noise.filters
    if filters is None:
        return None
    if settings.still:
        raise ValueError("windows of mosaics have no copies at rest; train a network that needs none")
    if not determines_bands(filters, noise.draw(clips[0]).sensor.efficiency):
        raise ValueError(f"{noise.sensor}: the mask {' '.join(filters.mask)} does not determine three bands")
    for clip in clips:
        for noise in noises:
            _turns_of_mosaic(filters, clip, noise, settings)
    return filters


def _turns_of_mosaic(
    filters: ColourFilter, clip: Clip, noise: Illumination, settings: WindowSettings
) -> dict[int, tuple[int, int]]:
    """Return the turns that windows of a clip may have, with the place of the tile at which they begin."""
    rows = noise.timing.rows
    allowed = TURNS if rows is None else TURNS_OF_ROWS[rows.axis]
    room = [size - settings.crop for size in clip.shape[1:]]
    return fitting_turns(filters, filters.shifted(*clip.origin), settings.crop, room, allowed)


def _check_codes(clips: Sequence[Clip], noise: Illumination, settings: WindowSettings) -> None:
    """Raise `ValueError` for a clip with fewer codes than a window has."""
    for clip in clips:
        codes = len(noise.timing.over(clip))
        if codes < settings.frames:
            raise ValueError(
                f"clip {clip.name} has {len(clip)} frames, which give {codes} codes of {noise.planes}; a window needs "
                f"{settings.frames}; choose fewer frames= or planes=, or longer clips"
            )


def check_clips(clips: Sequence[Clip], settings: WindowSettings) -> None:
    """Raise `ValueError` with the first clip that holds no window; its advice is for a network with this `least`."""
    if not clips:
        raise ValueError("no complete clip to draw windows from; check the split, or finish `qsim generate`")
    for clip in clips:
        length, height, width = clip.shape
        if length < settings.frames or min(height, width) < settings.crop:
            less = "choose fewer frames=" if length < settings.frames else "choose a smaller crop="
            longer = f"give clips of {settings.least} frames or more"
            advice = longer if length < settings.least else f"{less}, or other clips"
            raise ValueError(
                f"clip {clip.name} is {length} x {height} x {width}; a window needs {settings.frames} frames of "
                f"{settings.crop} x {settings.crop} px; {advice}"
            )


class Batches(Sampler[list[int]]):
    """Sample numbers of batch after batch, from batch `first` on; each of `world` processes gets a separate share."""

    def __init__(self, batch: int, first: int, last: int, rank: int = 0, world: int = 1) -> None:
        self.batch = batch
        self.first = first
        self.last = last
        self.rank = rank
        self.world = world

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.first, self.last):
            start = (step * self.world + self.rank) * self.batch
            yield list(range(start, start + self.batch))

    def __len__(self) -> int:
        return self.last - self.first
