"""Holds the state of a run, and derives from it the learning rate, due validations and the end."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from quiver.training.settings import Settings

WARMUP_SHARE = 0.05  # of a run, longest warm-up
PLATEAU_GAIN = 1e-4  # relative gain of PSNR that counts


@dataclass
class State:
    """State of a run, apart from weights and optimiser."""

    step: int = 0
    elapsed: float = 0.0  # s
    best: float = -math.inf  # validation PSNR, dB
    plateau_best: float = -math.inf
    plateau_bad: int = 0
    halvings: int = 0
    tenths: int = 0  # of the time of a run without `steps` that are over and validated
    finished: bool = False
    history: list[dict[str, float]] = field(default_factory=list)  # one entry per validation

    @classmethod
    def from_dict(cls, values: Any) -> State:
        """Return the state of values from `asdict`; ValueError for anything else."""
        kinds = {field.name: field.type for field in fields(cls)}
        if not isinstance(values, dict) or set(values) != set(kinds):
            raise ValueError(f"a state has {', '.join(kinds)}")
        for name, value in values.items():
            kind = type(value).__name__
            if name == "history":
                good = isinstance(value, list) and all(_is_entry(entry) for entry in value)
            elif kinds[name] == "int":
                good = kind == "int" and 0 <= value < 2**53
            else:
                good = kind == kinds[name] and value == value  # nothing is NaN
            if not good:
                raise ValueError(f"{name} is {repr(value)[:60]}")
        if values["elapsed"] < 0 or math.isinf(values["elapsed"]):
            raise ValueError(f"elapsed is {values['elapsed']}")
        return cls(**values)


def _is_entry(entry: Any) -> bool:
    """Return whether these are the numbers of one validation."""
    return (
        isinstance(entry, dict)
        and {"step", "elapsed", "loss", "psnr", "psnr_matched"} <= entry.keys()
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in entry.values())
    )


def share_used(settings: Settings, state: State) -> float:
    """Return the share of the run that is over, 0 to 1: by steps or by time, the larger one."""
    steps = state.step / settings.steps if settings.steps else 0.0
    minutes = state.elapsed / (60 * settings.minutes) if settings.minutes else 0.0
    return min(1.0, max(steps, minutes))


def learning_rate(settings: Settings, state: State) -> float:
    """Return the rate of the next step: a linear rise, then a cosine over the share of the run, or halvings.

    The rise ends after `warmup` steps or a twentieth of the run, whichever comes first.
    """
    share = share_used(settings, state)
    rise = max((state.step + 1) / max(1, settings.warmup), share / WARMUP_SHARE)
    rate = settings.learning_rate * min(1.0, rise)
    if settings.schedule == "plateau":
        return rate * 0.5**state.halvings
    # A cosine to 1 % rather than to 0, with which the last steps would learn nothing.
    return rate * max(0.01, 0.5 * (1 + math.cos(math.pi * share)))


def validation_due(settings: Settings, state: State) -> bool:
    """Return whether a validation is due: every `validate_every` steps, or after every tenth of a timed run."""
    if settings.steps is not None:
        return state.step % settings.validate_every == 0
    before = state.tenths
    state.tenths = int(10 * share_used(settings, state))
    return state.tenths > before


def time_is_up(settings: Settings, state: State, validation: float) -> bool:
    """Return whether another validation of that many seconds would exceed the time limit."""
    return settings.minutes is not None and state.elapsed + validation >= 60 * settings.minutes


def note_plateau(patience: int, state: State, psnr: float) -> None:
    """Count a validation, and halve the rate after more than `patience` in a row without a relative gain of 1e-4."""
    if state.plateau_best == -math.inf or psnr > state.plateau_best * (1 + PLATEAU_GAIN):
        state.plateau_best = psnr
        state.plateau_bad = 0
        return
    state.plateau_bad += 1
    if state.plateau_bad > patience:
        state.halvings = state.halvings + 1
        state.plateau_bad = 0
