"""Studies every speed and light level, and predicts the best bit depth from one study by a law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import rms
from qsim.colour import psnr
from qsim.files import Progress
from qsim.streams.clip import Clip
from qsim.studies.bit_depth.answer import answer, at_edge, code_motion, widened
from qsim.studies.bit_depth.clip_study import Study, StudyRow, check_clip, scored_pixels, study
from qsim.studies.bit_depth.clips import MovingClip
from qsim.studies.bit_depth.pixel_light import pixel_light
from qsim.studies.bit_depth.readout import MODELS, StudySettings, readouts
from qsim.tables import text_table


@dataclass(frozen=True)
class Sweep:
    """The studies at every speed and light level, `studies[i][j]` at `speeds[i]`, `ppps[j]`, with the law's depths."""

    speeds: tuple[float, ...]
    ppps: tuple[float, ...]
    studies: tuple[tuple[Study, ...], ...]
    predicted: dict[str, Array]  # model -> bits of the highest PSNR by the law, [len(speeds), len(ppps)]
    loss: dict[str, Array]  # dB by which the law's depth is worse than the simulated best, the same shape

    def to_dict(self) -> dict[str, object]:
        """Return the sweep for JSON."""
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
        """One sentence per study."""
        return [answer(found) for row in self.studies for found in row]

    @property
    def agreement(self) -> dict[str, float]:
        """Simulation against its exact expectation [standard errors], and the loss of the law's depths [dB]."""
        sigmas = np.array([row.sigmas for line in self.studies for found in line for row in found.rows])
        best = {m: np.array([[found.best(m).bits for found in line] for line in self.studies]) for m in MODELS}
        return {
            "simulated": sigmas.size,
            "rms_sigmas": rms(sigmas),
            "largest_sigmas": float(np.abs(sigmas).max()),
            "cells": sum(bits.size for bits in best.values()),
            "cells_with_another_depth": sum(int((best[m] != self.predicted[m]).sum()) for m in MODELS),
            "largest_loss_db": max(float(self.loss[m].max()) for m in MODELS),
        }


def study_dict(found: Study) -> dict[str, object]:
    """Return a study for JSON: rows, light, structure function."""
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
    clips: Sequence[MovingClip],
    ppps: Sequence[float],
    settings: StudySettings,
    *,
    widen: bool = False,
    progress: Progress | None = None,
) -> Sweep:
    """Study every clip at every light level; `widen` tries more bits while the deepest is best.

    The law predicts all cells from the **slowest** clip alone, at its middle light level.
    """
    for one in clips:
        check_clip(one.clip, replace(settings, speed=one.step))
    studies = []
    for i, one in enumerate(clips):
        row = []
        for j, ppp in enumerate(ppps):
            asked = replace(settings, speed=one.step, ppp=ppp)
            row.append(widened(one.clip, asked) if widen else study(one.clip, asked))
            if progress is not None:
                progress(i * len(ppps) + j + 1, len(clips) * len(ppps))
        studies.append(tuple(row))
    speeds = tuple(one.speed for one in clips)
    slowest = int(np.argmin(speeds))
    base = studies[slowest][len(ppps) // 2]
    clip = clips[slowest].clip
    predicted = {}
    loss = {}
    for model in MODELS:
        table = [
            [
                law(base, clip, replace(settings, bits=studies[i][j].bits), model, v / speeds[slowest], p)
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
    """Return one line: how well simulation, expectation and law agree."""
    a = found.agreement
    return (
        f"{a['simulated']} simulated PSNRs against their exact expectations: {a['rms_sigmas']:.2f} standard errors "
        f"rms, largest {a['largest_sigmas']:.1f}; the law gives another depth in {a['cells_with_another_depth']} of "
        f"{a['cells']} cells and loses at most {a['largest_loss_db']:.1f} dB"
    )


def law(base: Study, clip: Clip, settings: StudySettings, model: str, speed: float, ppp: float) -> dict[int, float]:
    """Return bits -> PSNR [dB] at another speed and light, from the structure function of one study and exact moments.

    `speed` is relative to that study. The noise is that of light that is constant during a frame.
    """
    frames = {t: pixel_light(clip, t, 1.0, settings.colour, sharp=True) for t in base.instants}
    whole = float(np.mean([frame.mean() for frame in frames.values()]))
    seen = replace(settings, speed=base.speed)
    light = np.concatenate([frame[scored_pixels(clip, t, seen)] for t, frame in frames.items()])
    # About 4000 quantiles stand for all pixels: the noise depends on the light alone.
    light = np.sort(light)[:: max(1, light.size // 4000)] * (ppp / whole)
    scale = (ppp / base.ppp) ** 2
    result = {}
    for form in readouts(settings, ppp, clip.exposure):
        if form.model == model:
            mean, variance = form.moments(form.planes * light)
            noise = float(np.mean((mean / form.planes - light) ** 2 + variance / form.planes**2))
            # The structure function is in photons^2, hence the squared ratio of light.
            error = noise + scale * base.structure.blur(form.planes, speed)
            result[form.bits] = psnr(base.peak * math.sqrt(scale), math.sqrt(error))
    return result


def _loss(found: Study, model: str, bits: int) -> float:
    chosen = next(row for row in found.rows if (row.model, row.bits) == (model, bits))
    return found.best(model).psnr_db - chosen.psnr_db


def _per_plane(motion: float | None, bits: int) -> float | None:
    return None if motion is None else motion / (2**bits - 1)


def table(found: Study) -> list[str]:
    """Return the lines of a study's table."""
    lux = "" if found.lux is None else f", {found.lux:.3g} lx at 555 nm"
    pixels = f" of the {100 * found.share:.3g} % of pixels that move" if found.moving else ""
    lines = [
        f"{found.clip}: {found.ppp:.4g} photons per pixel and plane{lux}; {found.frame_rate:g} planes/s, speed x"
        f"{found.speed}, {len(found.instants)} instants; errors are rms in photons per plane{pixels}, peak "
        f"{found.peak:.3g}",
    ]
    header = (
        "model",
        "bits",
        "fps",
        "px/frame",
        "blur",
        "(law)",
        "shot",
        "levels",
        "read",
        "SNR dB",
        "PSNR dB",
        "(expected)",
        "+-",
        "sigmas",
        "MB/s",
    )
    return lines + text_table(map(_cells, found.rows), header)


def _cells(row: StudyRow) -> list[str]:
    return [
        row.model,
        str(row.bits),
        f"{row.fps:.1f}",
        "-" if row.motion_px_per_frame is None else f"{row.motion_px_per_frame:.2f}",
        f"{row.blur_error:.3f}",
        f"({row.blur_predicted:.3f})",
        *(f"{error:.3f}" for error in (row.shot_error, row.quantisation_error, row.read_error)),
        "-" if row.snr_db is None else f"{row.snr_db:.2f}",
        f"{row.psnr_db:.2f}",
        f"({row.psnr_predicted_db:.2f})",
        f"{row.psnr_error_db:.2f}",
        f"{row.sigmas:.2f}",
        f"{row.data_rate_megabytes_per_second:.2f}",
    ]
