"""Looks up steps in Dr.Jit along the curves of curves.py, by one kernel for all sensors with as many steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from qsim.sensor.compiled.curves import Curves
from qsim.sensor.compiled.jit import backend, no_light, smaller, uniform32


def count(steps: int, photons: list[Any], words: Callable[[Any], list[Any]], given: list[Any]) -> tuple[list[Any], Any]:
    """Return codes and whether one is uncertain, with steps that are looked up; `given` is from `arguments`."""
    import drjit as dr

    jit = backend()
    efficiency, dark, margin, brightest, *curves = given
    uncertain = no_light(photons)
    codes = []
    for theta, word in zip(photons, words(jit.UInt32(0)), strict=True):
        x = dr.sqrt(dr.fma(jit.Float64(theta), efficiency, dark))
        u = uniform32(word)
        code = jit.UInt32(0)
        near = jit.Float(1)
        half = (steps + 1) // 2
        while half:
            distance = u - curve(curves, code + (half - 1), x)
            near = smaller(near, dr.abs(distance))
            code += dr.select(distance >= 0, jit.UInt32(half), jit.UInt32(0))
            half //= 2
        codes.append(code)
        uncertain |= ~(near >= margin) | (x > brightest)
    return codes, uncertain


def curve(curves: list[Any], k: Any, x: Any) -> Any:
    """Return step k (an index per pixel) at x = sqrt(arrivals)."""
    import drjit as dr

    jit = backend()
    start, rate, cells, cubics = curves
    at = (x - dr.gather(jit.Float64, start, k)) * dr.gather(jit.Float64, rate, k)
    at = dr.minimum(dr.maximum(at, 0.0), jit.Float64(cells))
    cell = dr.minimum(jit.UInt32(at), cells - 1)
    share = jit.Float(at - jit.Float64(cell))
    c0, c1, c2, c3 = dr.gather(jit.Array4f, cubics, k * cells + cell)
    return dr.fma(dr.fma(dr.fma(c3, share, c2), share, c1), share, c0)


def arguments(efficiency: float, dark: float, margin: float, steps: Curves) -> list[Any]:
    """Return a plan's numbers as kernel arguments.

    Efficiency, dark, margin, brightest; beginnings, cells per x, number of cells and cubics of all steps.
    """
    import drjit as dr

    jit = backend()
    scalars = [dr.opaque(jit.Float64, efficiency), dr.opaque(jit.Float64, dark)]
    scalars += [dr.opaque(jit.Float, margin), dr.opaque(jit.Float64, steps.brightest)]
    cells = dr.opaque(jit.UInt32, steps.cubics.shape[1])
    return [*scalars, jit.Float64(steps.start), jit.Float64(steps.rate), cells, jit.Float(steps.cubics.reshape(-1))]
