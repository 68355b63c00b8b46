"""Bit depth over speed and light: sources of clips, the sweep with its prediction, streams for restorers, figures."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import keys
from qsim.clip import stream
from qsim.clip.clip import Clip, ClipWriter
from qsim.clip.motion_statistics import CODE_BITS
from qsim.optics import radiometry
from qsim.sensor.spad import BinarySPAD
from qsim.studies.bit_depth.answer import answer, at_edge, code_motion, marked, widened
from qsim.studies.bit_depth.clip_study import (
    MODELS,
    Question,
    Study,
    check_clip,
    plane_sensor,
    readings,
    study,
)

COLOURS = {"planes": "tab:orange", "multibit": "tab:blue"}
Tell = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Moving:
    """A clip at one speed: rendered so (step 1), or of every `step`-th frame."""

    speed: float
    clip: Clip
    step: int = 1


@dataclass(frozen=True)
class Shape:
    """How a scene is rendered for a study."""

    frames: int
    height: int = 96
    width: int = 128
    frame_rate: float = 10_000.0
    psnr: float = 40.0  # wanted error of the radiance, dB
    seed: int = 0


def render(name: str, path: Path, shape: Shape, *, speed: float = 1.0, progress: Tell | None = None) -> Clip:
    """The scene as a clip; one that is already there is kept if it is the same scene, shape, rate and speed.

    `FileExistsError` if it is another one.
    """
    import scenes
    from qsim.rendering import fidelity
    from qsim.rendering.renderer import render_clip

    scene = scenes.load(name, seed=shape.seed, speed=speed).resized(shape.height, shape.width)
    if (path / "clip.json").is_file():
        clip = Clip.open(path)
        wanted = {"family": scene.name, "seed": scene.seed, "speed": scene.speed}
        same = clip.shape == (shape.frames, shape.height, shape.width) and clip.frame_rate == shape.frame_rate
        if same and clip.meta.get("scene") == wanted:
            return clip
        raise FileExistsError(f"{path}: exists and is another clip; name another folder with -o")
    frames, rate = shape.frames, shape.frame_rate
    chosen = fidelity.choose(scene, frame_rate=rate, frames=frames, psnr=shape.psnr, seed=shape.seed)
    return render_clip(scene, path, frames=frames, frame_rate=rate, seed=shape.seed, budget=chosen, progress=progress)


@dataclass(frozen=True)
class Sweep:
    """Studies at every (speed, light): `studies[i][j]` at `speeds[i]`, `ppps[j]`, and the law's best depths."""

    speeds: tuple[float, ...]
    ppps: tuple[float, ...]
    studies: tuple[tuple[Study, ...], ...]
    predicted: dict[str, Array]  # model -> bits of the highest PSNR by the law, [len(speeds), len(ppps)]
    loss: dict[str, Array]  # dB that the simulated best is above the law's choice, the same shape

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        cells = []
        for i, speed in enumerate(self.speeds):
            for j, ppp in enumerate(self.ppps):
                for model in MODELS:
                    best = self.studies[i][j].best(model)
                    cells.append(
                        {
                            "speed": speed,
                            "ppp": ppp,
                            "model": model,
                            "best_bits": best.bits,
                            "psnr_db": best.psnr_db,
                            "edge": at_edge(self.studies[i][j], model),
                            "motion_px_per_plane": _per_plane(best.motion_px_per_frame, best.bits),
                            "motion_px_per_code_frame": code_motion(best),
                            "best_bits_predicted": int(self.predicted[model][i, j]),
                            "loss_of_prediction_db": float(self.loss[model][i, j]),
                        }
                    )
        studies = [study_dict(s) for row in self.studies for s in row]
        return {"agreement": self.agreement, "cells": cells, "studies": studies, "answers": self.answers}

    @property
    def answers(self) -> list[str]:
        """A sentence for each cell."""
        return [answer(found) for row in self.studies for found in row]

    @property
    def agreement(self) -> dict[str, float]:
        """Simulation against its exact expectation, in standard errors, and what the law's choices cost."""
        sigmas = np.array([row.sigmas for line in self.studies for found in line for row in found.rows])
        best = {m: np.array([[found.best(m).bits for found in line] for line in self.studies]) for m in MODELS}
        return {
            "simulated": sigmas.size,
            "rms_sigmas": float(np.sqrt(np.mean(sigmas**2))),
            "largest_sigmas": float(np.abs(sigmas).max()),
            "cells": sum(bits.size for bits in best.values()),
            "cells_with_another_depth": sum(int((best[m] != self.predicted[m]).sum()) for m in MODELS),
            "largest_loss_db": max(float(self.loss[m].max()) for m in MODELS),
        }


def study_dict(found: Study) -> dict[str, Any]:
    """A study for JSON: rows, light, structure function."""
    result = {key: value for key, value in vars(found).items() if key not in ("rows", "structure")}
    result["rows"] = [asdict(row) for row in found.rows]
    result["structure_function"] = [float(v) for v in found.structure.values]
    result["best"] = {
        model: {"bits": found.best(model).bits, "edge": at_edge(found, model), "psnr_db": found.best(model).psnr_db}
        for model in MODELS
    }
    result["motion_px_per_code_frame"] = code_motion(found.rows[0])
    result["answer"] = answer(found)
    return result


def sweep(
    clips: Sequence[Moving],
    ppps: Sequence[float],
    question: Question,
    *,
    widen: bool = False,
    progress: Tell | None = None,
) -> Sweep:
    """Studies of every clip at every light level; `widen` tries more bits where the deepest is best, as clips allow.

    The law's choice everywhere comes from the **slowest** clip alone, at its middle light level.
    """
    for one in clips:
        check_clip(one.clip, replace(question, speed=one.step))
    studies = []
    for i, one in enumerate(clips):
        row = []
        for j, ppp in enumerate(ppps):
            asked = replace(question, speed=one.step, ppp=ppp)
            row.append(widened(one.clip, asked) if widen else study(one.clip, asked))
            if progress is not None:
                progress(i * len(ppps) + j + 1, len(clips) * len(ppps))
        studies.append(tuple(row))
    speeds = tuple(one.speed for one in clips)
    slowest = int(np.argmin(speeds))
    base, clip = studies[slowest][len(ppps) // 2], clips[slowest].clip
    predicted, loss = {}, {}
    for model in MODELS:
        table = [
            [
                law(base, clip, replace(question, bits=studies[i][j].bits), model, v / speeds[slowest], p)
                for j, p in enumerate(ppps)
            ]
            for i, v in enumerate(speeds)
        ]
        predicted[model] = np.array([[max(cell, key=lambda b: cell[b]) for cell in row] for row in table])
        loss[model] = np.array(
            [
                [_loss(cell, model, int(bits)) for cell, bits in zip(row, chosen, strict=True)]
                for row, chosen in zip(studies, predicted[model], strict=True)
            ]
        )
    return Sweep(speeds, tuple(ppps), tuple(studies), predicted, loss)


def summary(found: Sweep) -> str:
    """One line: how well simulation, expectation and law agree."""
    a = found.agreement
    return (
        f"{a['simulated']} simulated PSNRs against their exact expectations: {a['rms_sigmas']:.2f} standard errors "
        f"rms, largest {a['largest_sigmas']:.1f}; the law names another depth in {a['cells_with_another_depth']} of "
        f"{a['cells']} cells and gives away at most {a['largest_loss_db']:.1f} dB"
    )


def law(base: Study, clip: Clip, question: Question, model: str, speed: float, ppp: float) -> dict[int, float]:
    """bits -> PSNR from the structure function of one study and the sensor's exact moments, at another speed and light.

    `speed` is relative to that study. Pixels are taken as constant during a frame where noise is concerned.
    """
    light = np.concatenate([radiometry.clip_photons(clip, t, 1.0, sharp=True).ravel() for t in base.instants])
    light = np.sort(light)[:: max(1, light.size // 4000)]
    light, scale = light * (ppp / light.mean()), (ppp / base.ppp) ** 2
    result = {}
    for form in readings(question, ppp, clip.exposure):
        if form.model == model:
            mean, variance = form.moments(form.planes * light)
            noise = float(np.mean((mean / form.planes - light) ** 2 + variance / form.planes**2))
            error = noise + scale * base.structure.blur(form.planes, speed)
            result[form.bits] = 10 * math.log10(scale * base.peak**2 / error)
    return result


def _loss(found: Study, model: str, bits: int) -> float:
    chosen = next(row for row in found.rows if (row.model, row.bits) == (model, bits))
    return found.best(model).psnr_db - chosen.psnr_db


def _per_plane(motion: float | None, bits: int) -> float | None:
    return None if motion is None else motion / (2**bits - 1)


def write_streams(clip: Clip, folder: Path, question: Question) -> list[Path]:
    """One clip per bit depth, FOLDER/NAME_3bit, with the streams `planes` and `multibit`; returns their paths.

    Its frames are the means of 2^b - 1 frames of `clip`, its sharp frames the middle ones, so that
    `quiver evaluate FOLDER/NAME_3bit --stream planes` scores any restorer against the sharp instants.
    """
    check_clip(clip, question)
    level = radiometry.light_level(clip, ppp=question.ppp)
    plane = plane_sensor(question, level.ppp, clip.exposure)
    if not isinstance(plane, BinarySPAD):
        raise ValueError("streams of summed planes need a clocked SPAD; leave out the plane sensor")
    made = []
    for bits in question.bits:
        m = 2**bits - 1
        path = folder / f"{clip.name}_{bits}bit"
        grouped = group(clip, path, m)
        read = stream.Sensing(question.sensor, bits, ppp=m * level.ppp, seed=question.seed, name="multibit")
        stream.sense(grouped, read)
        key = keys.Key(seed=question.seed, clip=keys.hash_name(clip.name))
        draw = stream.Draw(replace(plane, bits=bits), plane, level, key, m, False)
        meta = stream.describe(clip, replace(read, name="planes"), draw) | {"planes_of": str(clip.path)}
        meta |= {"ppp_target": m * level.ppp, "sensor_name": "planes"}
        frames = (draw.frames(clip, t, t + 1) for t in range(len(grouped)))
        stream.write_stream(grouped, "planes", frames, draw.sensor, meta)
        made.append(path)
    return made


def group(clip: Clip, path: Path, m: int) -> Clip:
    """A clip whose frames are means of m frames (m odd) and whose sharp frames are the middle ones."""
    kept = ("radiance_unit", "camera", "scene", "split", "origin", "seed", "render")
    meta = {key: clip.meta[key] for key in kept if key in clip.meta}
    frames, height, width = clip.shape
    meta |= {"shape": [frames // m, height, width], "frame_rate": clip.frame_rate / m, "exposure": clip.exposure * m}
    meta |= {"shutter": 1.0, "grouped": {"from": clip.name, "frames": m}}
    with ClipWriter(path, meta) as writer:
        for t in range(frames // m):
            mean = np.stack([clip.radiance(t * m + i) for i in range(m)]).mean(axis=0, dtype=np.float64)
            writer.add(t, np.asarray(mean, np.float32), clip.sharp(t * m + m // 2) if m > 1 else None)
    return Clip.open(path)


# figures, PNG


def study_figure(found: Study) -> bytes:
    """PSNR and the parts of the error over bit depth: points simulated, lines expected."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(10, 3.8), dpi=120, layout="constrained")
    left, right = drawing.subplots(1, 2)
    for model in MODELS:
        rows = [row for row in found.rows if row.model == model]
        bits, colour = [row.bits for row in rows], COLOURS[model]
        left.plot(bits, [row.psnr_predicted_db for row in rows], color=colour, label=f"{model}, expected")
        errors = [2 * row.psnr_error_db for row in rows]
        left.errorbar(bits, [row.psnr_db for row in rows], errors, fmt="o", color=colour, label=f"{model}, simulated")
    rows = [row for row in found.rows if row.model == "multibit"]
    bits = [row.bits for row in rows]
    for field, style in (("blur_error", "o"), ("shot_error", "s"), ("quantisation_error", "^"), ("read_error", "v")):
        values = np.abs([getattr(row, field) for row in rows]) / found.peak
        right.plot(
            bits, np.where(values > 0, values, np.nan), style, label=f"|{field.replace('_', ' ')}|", linestyle="-"
        )
    right.plot(bits, [row.blur_predicted / found.peak for row in rows], "k:", label="blur by the structure function")
    left.set_ylabel("PSNR of the likeliest frame [dB]")
    right.set_ylabel("rms error / peak (multibit)")
    right.set_yscale("log")
    for axes in (left, right):
        axes.set_xlabel("bits per frame of 2^b - 1 planes")
        axes.set_xticks(bits)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    lux = "" if found.lux is None else f" ({found.lux:.3g} lx at 555 nm)"
    drawing.suptitle(f"{found.clip}: {found.ppp:.3g} photons per pixel and plane{lux}, {found.frame_rate:g} planes/s")
    return _png(drawing)


def sweep_figure(found: Sweep) -> bytes:
    """Best bit depth over speed and light: coloured cells and large numbers simulated, small ones by the law."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 4.2), dpi=120, layout="constrained")
    bits = [row.bits for line in found.studies for one in line for row in one.rows]
    for axes, model in zip(drawing.subplots(1, 2), MODELS, strict=True):
        table = np.array([[s.best(model).bits for s in row] for row in found.studies])
        axes.imshow(table, origin="lower", aspect="auto", cmap="viridis", vmin=min(bits), vmax=max(bits))
        for (i, j), best in np.ndenumerate(table):
            near = "white" if best < (min(bits) + max(bits)) / 2 else "black"
            axes.text(j, i, marked(found.studies[i][j], model), ha="center", va="bottom", color=near, fontsize=12)
            axes.text(j, i, f"law {found.predicted[model][i, j]}", ha="center", va="top", color=near, fontsize=7)
        axes.set_xticks(range(len(found.ppps)), [f"{p:g}" for p in found.ppps])
        axes.set_yticks(range(len(found.speeds)), [_speed_label(found, i) for i in range(len(found.speeds))])
        axes.set_xlabel("photons per pixel and plane")
        axes.set_ylabel(f"speed (px per {CODE_BITS}-bit frame)")
        axes.set_title(f"best bits, {model}")
    return _png(drawing)


def _speed_label(found: Sweep, i: int) -> str:
    row = found.studies[i][0].rows[0]
    motion = code_motion(row)
    return f"{found.speeds[i]:g}" + ("" if motion is None else f" ({motion:.2g})")


def _png(drawing: Any) -> bytes:
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png")
    return buffer.getvalue()


def table(found: Study) -> list[str]:
    """The study in words and columns."""
    lux = "" if found.lux is None else f", {found.lux:.3g} lx at 555 nm"
    lines = [
        f"{found.clip}: {found.ppp:.4g} photons per pixel and plane{lux}; {found.frame_rate:g} planes/s, speed x"
        f"{found.speed}, {len(found.instants)} instants; errors are rms in photons per plane, peak {found.peak:.3g}",
        "model     bits       fps  px/frame   blur (law)       shot   levels     read  SNR dB   PSNR dB (expected)"
        "     +-  sigmas    MB/s",
    ]
    return lines + [_line(row) for row in found.rows]


def _line(r: Any) -> str:
    motion = "-" if r.motion_px_per_frame is None else f"{r.motion_px_per_frame:.2f}"
    return (
        f"{r.model:9} {r.bits:4d} {r.fps:9.1f}  {motion:>8}  {r.blur_error:6.3f} ({r.blur_predicted:.3f})"
        f"  {r.shot_error:7.3f}  {r.quantisation_error:7.3f}  {r.read_error:7.3f}  {r.snr_db:6.2f}"
        f"    {r.psnr_db:6.2f} ({r.psnr_predicted_db:6.2f})  {r.psnr_error_db:5.2f}  {r.sigmas:6.2f}"
        f"  {r.data_rate_megabytes_per_second:6.2f}"
    )


def clips_for(
    source: str, speeds: Sequence[float], shape: Shape, folder: Path | None, progress: Tell | None = None
) -> Iterator[Moving]:
    """A clip folder (whole speeds from 1), or a scene rendered at each speed into FOLDER/clips."""
    if (Path(source) / "clip.json").is_file():
        clip = Clip.open(source)
        if any(v < 1 or not float(v).is_integer() for v in speeds):
            raise ValueError(f"{source}: a clip can be made faster by whole factors only; other speeds need a scene")
        yield from (Moving(v, clip, int(v)) for v in speeds)
        return
    import scenes

    if source not in scenes.FAMILIES and not source.endswith(".py"):
        raise FileNotFoundError(f"{source}: neither a clip folder nor a scene; there are {', '.join(scenes.FAMILIES)}")
    if folder is None:
        raise ValueError(f"{source} is a scene: give a folder for its clip with -o")
    for v in speeds:
        path = folder / "clips" / f"{Path(source).stem}_x{v:g}"
        yield Moving(v, render(source, path, shape, speed=v, progress=progress))
