"""Makes 95 % intervals from the profile of the likelihood, scaled to the covariance between pixels.

A parameter is held at a value and all others are fitted again. Its signed root sqrt(2 (log L_max - log L) / scale) is
normal; scale is the variance of the sandwich over that of the information (Pace et al., Statistica Sinica 21, 2011).
Where the likelihood is a parabola this is the interval of the standard error. Near the bound of a parameter, which
cannot be negative, the limits of the root are those of Feldman and Cousins (Phys. Rev. D 57, 1998). The interval then
holds the truth in 95 and not in 97.5 of 100 cases.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, sqrt

from numpy import ndarray as Array

from qsim.calibration.histogram_fit import Fit, State
from qsim.calibration.results import Z95

ONE_SIDED = 1.645  # root of the one-sided limit, at the bound
RISE = 0.18  # of the limit of the root per standard deviation from the bound, until it is Z95
CLOSE = 0.03  # to which the root is met, relative
SHARP = 0.5  # codes of read noise; below, the likelihood has several maxima
WIDEST = 10.0  # most variance between pixels, relative to that of the likelihood
HIGHER = 0.05  # of a log likelihood; less is the error of a maximum


@dataclass(frozen=True)
class Interval:
    value: float
    low: float
    high: float
    parabola: bool  # whether the likelihood is one between the ends


def profile(fit: Fit, direction: Array, step: float, farthest: float, *, bound: float = -inf) -> Interval:
    """Return the interval of direction [m] @ parameters. `bound` is the value that cannot be passed.

    `step` is the first step where the standard error is larger. An end further than `farthest` away is infinite.
    """
    value = float(direction @ fit.state.parameters)
    variance = float(direction @ fit.covariance @ direction)
    naive = float(direction @ fit.inverse @ direction)
    # where the likelihood is no parabola the two differ without a reason, so the interval never gets narrower by it
    scale = min(max(variance / naive, 1.0), WIDEST) if naive > 0 and variance > 0 else 1.0
    error = sqrt(variance) if variance > 0 and isfinite(variance) else inf
    error = min(error, step)
    search = _Search(fit, direction, scale, value, error, farthest)
    at_bound = value - bound < 1e-9 * max(abs(value), 1.0) if isfinite(bound) else False
    # At a bound half of the normal law is cut off, so that the other end is a
    # one-sided quantile; between, the quantile rises evenly.
    if at_bound:
        high, _ = search.end(1, ONE_SIDED + RISE * 0.9, inf)
        return Interval(value, bound, high, False)
    target = Z95
    if isfinite(bound) and value - 4.5 * error < bound:
        root = search.root(bound)
        if root < ONE_SIDED:
            high, _ = search.end(1, Z95, inf)
            return Interval(value, bound, high, False)
        target = min(Z95, (ONE_SIDED + RISE * root) / (1 + RISE))
    low, first = search.end(-1, target, bound)
    high, second = search.end(1, Z95, inf)
    # A second maximum outside of the interval that is nearly as likely belongs to it.
    for mode in fit.modes:
        at = float(direction @ mode.parameters)
        root = search.root_of(mode)
        if at < low and root < target:
            low, first = search.end(-1, target, bound, mode)
        if at > high and root < Z95:
            high, second = search.end(1, Z95, inf, mode)
    return Interval(value, low, high, first and second)


class HigherMaximum(Exception):
    """A profile met a larger likelihood than that of the fit, which is therefore to be repeated from `state`."""

    def __init__(self, state: State) -> None:
        super().__init__("the fit was a local maximum")
        self.state = state


class _Search:
    """The signed root of the likelihood along one direction of the parameters."""

    def __init__(self, fit: Fit, direction: Array, scale: float, value: float, error: float, farthest: float) -> None:
        self.fit = fit
        self.direction = direction
        self.scale = scale
        self.value = value
        self.error = error
        self.farthest = farthest
        along = fit.inverse @ direction
        # Where the direction is held, the others follow along inverse
        # information times direction: the ridge of the likelihood.
        size = float(direction @ along)
        self.along = along / size if size > 0 else direction / float(direction @ direction)
        self.last: State = fit.state

    def root(self, at: float) -> float:
        """Return the root at a value of the parameter, above 0 on both sides."""
        state = max((self._held(start) for start in self._starts(at)), key=lambda state: state.value)
        self.last = state
        return self.root_of(state)

    def root_of(self, state: State) -> float:
        """Return the root of a state; `HigherMaximum` if its likelihood exceeds that of the fit."""
        if state.value > self.fit.state.value + HIGHER:
            raise HigherMaximum(state)
        # The signed root: standard errors of a normal law, over the
        # scatter between pixels that the model does not know.
        return sqrt(max(2 * (self.fit.state.value - state.value), 0.0) / self.scale)

    def _starts(self, at: float) -> list[Array]:
        """Return parameters with the value `at`, from which the others are fitted; several where maxima are many."""
        near = self.last.parameters
        found = [near + self.along * (at - float(self.direction @ near))]
        if self.fit.gain * self.fit.noise > SHARP:
            return found
        for state in (self.last, self.fit.state, *self.fit.modes):
            base = state.parameters
            plain = base + self.direction * (at - float(self.direction @ base)) / float(self.direction @ self.direction)
            found.append(plain)
        return found

    def _held(self, start: Array) -> State:
        """Return the fit from a start with the value of the parameter kept."""
        at = float(self.direction @ start)
        moved = self.fit.likelihood.inside(start)
        moved = moved + self.direction * ((at - float(self.direction @ moved)) / float(self.direction @ self.direction))
        return self.fit.likelihood.maximise(moved, hold=self.direction, rounds=25, enough=2e-3)

    def end(self, side: int, target: float, bound: float, mode: State | None = None) -> tuple[float, bool]:
        """Return the value where the root is `target`, and whether it lies at `target` standard errors.

        The search starts at the fit, or at another maximum of the likelihood.
        """
        self.last = mode or self.fit.state
        limit = bound if side < 0 else inf  # only a lower end has a bound
        near = float(self.direction @ self.last.parameters)
        at_near = self.root_of(self.last)
        far = near + side * sqrt(max(target**2 - at_near**2, 0.1)) * self.error
        for count in range(20):
            far = max(far, limit) if side < 0 else far
            found = self.root(far)
            if abs(found / target - 1) < CLOSE:
                return near + (far - near) * (target - at_near) / (found - at_near), count == 0 and mode is None
            if found > target:
                return self._between(near, far, at_near, found, target), False
            if far == limit:
                return bound, False
            if abs(far - self.value) > self.farthest:
                break
            near = far
            at_near = found
            far = self.value + (far - self.value) * min(max(1.1 * target / max(found, 1e-3), 1.2), 3.0)
        return side * inf, False

    def _between(self, near: float, far: float, at_near: float, at_far: float, target: float) -> float:
        """Return the value between two others where the root is `target`, by false position kept off the ends."""
        for _ in range(12):
            share = (target - at_near) / (at_far - at_near)
            middle = near + (far - near) * min(max(share, 0.08), 0.92)
            found = self.root(middle)
            if abs(found / target - 1) < CLOSE:
                return middle
            if found < target:
                near = middle
                at_near = found
            else:
                far = middle
                at_far = found
        return far
