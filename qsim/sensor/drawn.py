"""A sensor that states how its codes are drawn, and no law of them.

    draw_codes(photons, exposure, uniform) -> codes

It can be sensed, stored, drawn again, shown, converted, and trained on. What needs the law of the codes is refused:
moments, likelihood, exact inverse response, Fisher information. A sensor that states its cdf has all of these.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NoReturn

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, uniform, words, words_at
from qsim.sensor.sensor import Sensor

Uniform = Callable[[int], Array]


class DrawnSensor(Sensor):
    """A pixel without memory of which only a drawing function is known. Subclasses are frozen dataclasses."""

    code_model: ClassVar[str] = "drawn"
    efficiency: ClassVar[float] = 1.0  # events per photon, for what is said of the light
    dark_rate: ClassVar[float] = 0.0

    @abstractmethod
    def draw_codes(self, photons: Array, exposure: float, uniform: Uniform) -> Array:
        """Return the codes [n] of expected photons [n] in an exposure [s], whole numbers from 0 to 2^bits - 1.

        `uniform(i)` returns the i-th random number of each pixel, float64 [n] in (0, 1), i = 0, 1, ... They depend on
        clip, seed, frame and pixel alone, so that every order of drawing gives the same codes.
        """

    def draw_block(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int], planes: int = 0) -> Array:
        shape = (planes, *photons.shape) if planes else photons.shape
        light = np.broadcast_to(photons, shape).ravel()
        drawn = self._checked(light, exposure, lambda i: uniform(words(key, shape, origin, redraw=i)).ravel())
        return drawn.reshape(shape)

    def draw_at(self, photons: Array, exposure: float, *, key: Key, at: Array) -> Array:
        return self._checked(photons, exposure, lambda i: uniform(words_at(key, at, redraw=i)))

    def _checked(self, photons: Array, exposure: float, numbers: Uniform) -> Array:
        self.arrivals(photons, exposure)  # names photons that no sensor can see
        codes = np.asarray(self.draw_codes(photons, exposure, numbers))
        if codes.shape != photons.shape or (codes.size and not (codes.min() >= 0 and codes.max() < self.levels)):
            raise ValueError(
                f"{type(self).__name__}.draw_codes: expected {photons.size} codes from 0 to {self.levels - 1}, got "
                f"{list(codes.shape)} of {codes.min() if codes.size else 'none'} to "
                f"{codes.max() if codes.size else 'none'}"
            )
        return codes.astype(self.dtype)

    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        self._refuse()

    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        self._refuse()

    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise ValueError(
            f"{type(self).__name__}: states how codes are drawn and not their law, which this needs; state its cdf"
        )
