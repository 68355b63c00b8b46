"""Finds the speed for a wanted motion, widens a study while its deepest frame is best, states the best depth.

A **plane** is one clip frame read with one bit. A **frame** of b bits is 2^b - 1 planes, and a **code** is the value of
a pixel in one frame. Motion is the mean over the pixels that move more than 0.1 px per frame of `CODE_BITS` bits, and
over a few frames of the clip (`qsim.clip.motion_statistics`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from qsim.clip.motion_statistics import CODE_BITS, CODE_PLANES, looks, moving_mean
from qsim.streams.clip import Clip
from qsim.studies.bit_depth import restored_bits
from qsim.studies.bit_depth.clip_study import Study, StudyRow, mean_motion, study
from qsim.studies.bit_depth.readout import MODELS, StudySettings

WIDEST = 7  # bits: the largest depth to which a study is widened
SPEEDS = (1e-3, 1e3)  # factors on a scene's motion that are tried
CLOSE = 0.01  # relative difference to the wanted motion at which the search ends
NEAR = 0.05  # largest relative difference that is accepted


def scene_motion(name: str, size: tuple[int, int], *, frames: int, frame_rate: float, seed: int, speed: float) -> float:
    """Return the motion of a scene [px per frame of 3 bits]: the mean over its `looks`; 0 if nothing moves.

    The flow comes from rays to the first surfaces; nothing is rendered.
    """
    from qsim import scenes
    from qsim.rendering.renderer import Renderer

    renderer = Renderer(scenes.load(name, seed=seed, speed=speed).resized(*size), frame_rate=frame_rate)
    found = []
    for t in looks(frames):
        u, v = renderer.truth(t)["flow"]
        found.append(moving_mean(np.hypot(u, v), CODE_PLANES) or 0.0)
    return float(np.mean(found))


def speed_for(px: float, motion: Callable[[float], float], name: str) -> tuple[float, float]:
    """Return (speed factor, motion reached) for a scene whose motion [px] at a factor is `motion(factor)`.

    Raise `ValueError` if the scene is still or if no factor comes within 5 %.
    """
    low, high = SPEEDS
    speed = 1.0
    tried = {}
    for _ in range(10):
        tried[speed] = motion(speed)
        if abs(tried[speed] / px - 1) < CLOSE:
            break
        if tried[speed] > 0:
            after = float(np.clip(speed * px / tried[speed], low, high))
        elif max(tried.values()) > 0:
            after = (speed * max(tried)) ** 0.5  # below MOVING everywhere: try between this and the fastest
        else:
            after = high if speed < high else speed
        if after in tried:
            break
        speed = after
    if max(tried.values()) == 0:
        raise ValueError(f"{name}: nothing in it moves, so px={px:g} cannot be reached; leave px= out")
    best = min(tried, key=lambda v: abs(tried[v] - px))
    if abs(tried[best] / px - 1) > NEAR:
        raise ValueError(
            f"{name}: px={px:g} cannot be reached; speed factor {best:.4g} gives {tried[best]:.3g} px per "
            f"{CODE_BITS}-bit frame, the nearest of {low:g} to {high:g}"
        )
    return float(f"{best:.4g}"), tried[best]


def step_for(px: float, clip: Clip) -> tuple[int, float]:
    """Return (step, motion reached) for a clip: reading every `step`-th frame makes it so many times faster.

    Raise `ValueError` if the clip has no ground truth, is still, or moves faster already.
    """
    if not clip.has_truth:
        raise ValueError(f"{clip.path}: has no ground truth, so its motion is unknown; give speed= instead of px=")
    motions: dict[int, float] = {}

    def at(step: int) -> float:
        if step not in motions:
            motions[step] = CODE_PLANES * (mean_motion(clip, step) or 0.0)
        return motions[step]

    if at(max(1, len(clip))) == 0:
        raise ValueError(f"{clip.path}: nothing in it moves, so px={px:g} cannot be reached; leave px= out")
    if at(1) > 1.5 * px:
        raise ValueError(
            f"{clip.path}: moves {at(1):.3g} px per {CODE_BITS}-bit frame, and a clip can only be made faster; px="
            f"{px:g} needs a scene, or a clip at a higher frame rate"
        )
    guess = max(1, round(px / at(1))) if at(1) > 0 else len(clip)
    step = min(range(max(1, guess - 3), guess + 4), key=lambda k: abs(at(k) - px))
    return step, at(step)


# The best depth


def at_edge(found: Study, model: str) -> str:
    """Return ">=" if the best depth is the deepest tried, "<=" if it is the shallowest above 1 bit, else ""."""
    bits = [row.bits for row in found.rows if row.model == model]
    best = found.best(model).bits
    if best == max(bits):
        return ">="
    return "<=" if best == min(bits) > 1 else ""


def marked(found: Study, model: str) -> str:
    """Return the best depth with its mark, as "4" or ">= 5"."""
    return f"{at_edge(found, model)} {found.best(model).bits}".strip()


def widened(clip: Clip, settings: StudySettings, note: Callable[[str], None] | None = None) -> Study:
    """Return the study, with one more bit at a time while the deepest is best, up to 7 bits and the clip's length."""
    found = study(clip, settings)
    while any(at_edge(found, model) == ">=" for model in MODELS) and settings.bits[-1] < WIDEST:
        settings = replace(settings, bits=(*settings.bits, settings.bits[-1] + 1))
        if len(clip) < settings.longest:
            break
        if note is not None:
            note(f"the deepest tried is best: {settings.bits[-1]} bits are tried too")
        found = study(clip, settings)
    return found


def code_motion(row: StudyRow) -> float | None:
    """Return the motion of a row [px per frame of 3 bits]."""
    return None if row.motion_px_per_frame is None else row.motion_px_per_frame / (2**row.bits - 1) * CODE_PLANES


def answer(found: Study) -> str:
    """Return one sentence: the best depth of both readouts, how many dB its neighbours are worse, and once restored."""
    motion = code_motion(found.rows[0])
    where = "at unknown motion" if motion is None else f"at {motion:.3g} px per {CODE_BITS}-bit frame"
    seen = "one frame, pixels that move" if found.moving else "one frame, still pixels included"
    depths = [_of_model(found, model) for model in MODELS]
    if motion is not None:
        depths.append(restored_bits.sentence(motion, found.ppp))
    return f"{where} and {found.ppp:.3g} photons per plane, {seen}: " + "; ".join(depths)


def _of_model(found: Study, model: str) -> str:
    best = found.best(model)
    edge = at_edge(found, model)
    rows = sorted((row for row in found.rows if row.model == model), key=lambda row: row.bits)
    place = rows.index(best)
    beside = [row for row in (rows[place - 1] if place else None, *rows[place + 1 : place + 2]) if row is not None]
    worse = restored_bits.worse({row.bits: best.psnr_db - row.psnr_db for row in beside})
    text = f"{model} {marked(found, model)} bit{'s' if best.bits > 1 else ''}{worse}"
    if edge == ">=":
        text += " (the deepest tried"
        text += f": try bits 1,...,{min(best.bits + 2, 10)})" if best.bits < 10 else ")"
    if edge == "<=":
        text += " (the shallowest tried: try bits 1,...)"
    return text
