"""Turns numbers into values that JSON can hold: it has no NaN and no infinity."""

from __future__ import annotations

import math
from typing import Any


def json_safe(value: Any, *, infinite: bool = False) -> Any:
    """Return the same value with null for NaN and infinities; with `infinite` these become the texts inf and -inf."""
    if isinstance(value, dict):
        return {name: json_safe(v, infinite=infinite) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(v, infinite=infinite) for v in value]
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return str(value) if infinite and math.isinf(value) else None


def number(value: Any) -> Any:
    """Return the number that `json_safe` stored with `infinite`; NaN for null."""
    if value is None:
        return math.nan
    return float(value) if isinstance(value, str) else value
