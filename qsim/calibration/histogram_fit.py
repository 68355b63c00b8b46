"""Fits the histograms of a camera's dark and flat frames by maximum likelihood.

Parameters: ln gain [codes/e-], offset [codes], ln read noise [e-], dark electrons of the longest exposure, and the
expected electrons of every cell of a flat. Time enters through ratios of exposures only. The covariance is the sandwich
I^-1 J I^-1 (White, Econometrica 50, 1982); J is summed over pixels, whose codes share light and excess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, log, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import Cell
from qsim.calibration.code_law import Law, code_law
from qsim.calibration.goodness import NODES, WEIGHTS, goodness  # noqa: F401  (spad.py takes them from here)
from qsim.calibration.starts import distinct, starts_of

GAIN, OFFSET, NOISE, DARK = range(4)
SHARED = 4  # parameters before those of the cells
BRIGHT = 150.0  # e-; above, an Edgeworth series replaces the sum over electrons, if read noise hides the electrons
HIDDEN = 0.8  # e- of read noise that hides the electrons
FINEST = 3.0  # bins in one standard deviation of the read noise
MOST_BINS = 1200
STARTS = 4  # that are followed
FEW_BITS = 6  # up to here a fit is quick, and has more local maxima
MORE_STARTS = 10
LEAST_NOISE = 0.05  # codes; less read noise changes no histogram


@dataclass(frozen=True, eq=False)
class Panel:
    """Cells whose codes share bins."""

    cells: tuple[int, ...]
    edges: Array  # [B - 1] highest codes of the bins but the last
    place: Array  # [levels] bin of a code
    middle: Array  # [B] code that stands for a bin
    counts: Array  # [cells, B]
    smooth: bool


@dataclass(frozen=True, eq=False)
class State:
    """The likelihood at some parameters."""

    parameters: Array
    value: float
    score: Array  # [m]
    information: Array  # [m, m]
    laws: tuple[Law, ...]


class Likelihood:
    """The likelihood of all cells, as a function of the parameters."""

    def __init__(
        self, cells: Sequence[Cell], exposures: Sequence[float], darks: int, bits: int, start: Array, *, hidden: bool
    ) -> None:
        self.cells, self.bits, self.darks = tuple(cells), bits, darks
        longest = max(exposures[:darks])
        self.share = np.array([exposures[c.stack] / longest if c.stack < darks else 0.0 for c in cells])
        self.dark = np.array([c.stack < darks for c in cells])
        self.excess = np.array([c.excess for c in cells])
        self.response = np.ones(len(cells))  # d mean code / d light, relative to the gain
        self.own = np.where(self.dark, -1, SHARED - 1 + np.cumsum(~self.dark))
        self.size = SHARED + int(np.count_nonzero(~self.dark))
        self.panels = tuple(self._panels(start, hidden))

    def _panels(self, start: Array, hidden: bool) -> list[Panel]:
        """Return one panel of all dim cells, and those of the bright ones: one per stack if no electron shows."""
        gain, noise = exp(start[GAIN]), exp(start[NOISE])
        electrons = self.means(start)
        dim = [i for i, mean in enumerate(electrons) if mean <= BRIGHT]
        together: dict[tuple[int, int], list[int]] = {}
        for i, cell in enumerate(self.cells):
            if i not in dim:  # with an exact sum every bright cell has bins of its own, because its range is short
                together.setdefault((cell.stack, 0 if hidden else i), []).append(i)
        panels = [self._panel(dim, gain * noise / FINEST, smooth=False)] if dim else []
        for members in together.values():
            step = gain * noise / FINEST
            if hidden:
                step = sqrt(min(self.cells[i].variance for i in members)) / 5
            panels.append(self._panel(members, step, smooth=hidden))
        return panels

    def _panel(self, members: list[int], step: float, *, smooth: bool) -> Panel:
        levels = 1 << self.bits
        seen = np.zeros(levels, np.int64)
        codes = [self.cells[i].codes.ravel() for i in members]
        for values in codes:
            seen += np.bincount(values, minlength=levels)
        low, high = np.flatnonzero(seen)[[0, -1]]
        step = max(int(step), 1, -(-(high - low) // MOST_BINS))
        edges = np.arange(low + step - 1 if low else 0, min(high + step, levels - 1), step)
        if high == levels - 1:  # saturated codes have a bin of their own
            edges = np.union1d(edges, [levels - 2])
        place = np.searchsorted(edges, np.arange(levels))
        middle = np.concatenate([[edges[0]], (edges[1:] + edges[:-1] + 1) / 2, [edges[-1] + 1]])
        counts = np.stack([np.bincount(place[v], minlength=len(edges) + 1) for v in codes]).astype(float)
        return Panel(tuple(members), edges.astype(float), place, middle, counts, smooth)

    def means(self, parameters: Array) -> Array:
        """Return the expected electrons of all cells."""
        own = parameters[np.maximum(self.own, SHARED)] if self.size > SHARED else np.zeros(len(self.cells))
        return np.maximum(np.where(self.dark, self.share * parameters[DARK], own), 1e-9)

    def spreads(self, gain: float, excess: Array | None = None) -> Array:
        """Return the variance of the expected electrons within the cells."""
        return np.where(self.dark, 0.0, (self.excess if excess is None else excess) / (gain * self.response) ** 2)

    def laws(self, parameters: Array, excess: Array | None = None) -> tuple[Law, ...]:
        gain, offset, noise = exp(parameters[GAIN]), float(parameters[OFFSET]), exp(parameters[NOISE])
        mean, spread = self.means(parameters), self.spreads(gain, excess)
        return tuple(
            code_law(
                panel.edges,
                gain,
                offset,
                noise,
                mean[list(panel.cells)],
                spread[list(panel.cells)],
                smooth=panel.smooth,
            )
            for panel in self.panels
        )

    def value(self, parameters: Array) -> float:
        """Return the log likelihood."""
        return sum(
            float(np.sum(panel.counts * np.log(law.shares)))
            for panel, law in zip(self.panels, self.laws(parameters), strict=True)
        )

    def slopes(self, panel: Panel, law: Law, parameters: Array, excess: Array | None = None) -> Array:
        """Return dP by ln gain, offset, ln read noise, dark electrons and the cell's own mean: [5, cells, B]."""
        members = list(panel.cells)
        spread = self.spreads(exp(parameters[GAIN]), excess)[members][:, None]
        by_gain = law.by_gain - 2 * spread * law.by_spread
        share = self.share[members][:, None]
        dark = self.dark[members][:, None]
        return np.stack([by_gain, law.by_offset, law.by_noise, share * law.by_mean, np.where(dark, 0.0, law.by_mean)])

    def at(self, parameters: Array) -> State:
        """Return value, score and information at some parameters."""
        laws = self.laws(parameters)
        value, score, information = 0.0, np.zeros(self.size), np.zeros((self.size, self.size))
        for panel, law in zip(self.panels, laws, strict=True):
            members = list(panel.cells)
            slope = self.slopes(panel, law, parameters)
            value += float(np.sum(panel.counts * np.log(law.shares)))
            pushes = np.einsum("qrb,rb->qr", slope, panel.counts / law.shares)
            weight = panel.counts.sum(axis=1)[:, None] / law.shares
            fisher = np.einsum("qrb,rb,prb->qpr", slope, weight, slope, optimize=True)
            score[:SHARED] += pushes[:SHARED].sum(axis=1)
            information[:SHARED, :SHARED] += fisher[:SHARED, :SHARED].sum(axis=2)
            for r, i in enumerate(members):
                k = self.own[i]
                if k >= 0:
                    score[k] += pushes[SHARED, r]
                    information[k, k] += fisher[SHARED, SHARED, r]
                    information[:SHARED, k] += fisher[:SHARED, SHARED, r]
                    information[k, :SHARED] += fisher[:SHARED, SHARED, r]
        return State(parameters, value, score, information, laws)

    def bounds(self, parameters: Array) -> Array:
        """Return the lower bounds of the parameters."""
        return np.array([-inf, -inf, log(LEAST_NOISE) - parameters[GAIN], 0.0, *[1e-6] * (self.size - SHARED)])

    def inside(self, parameters: Array) -> Array:
        """Return the parameters, moved within their bounds; read noise and light end where no code can vary more."""
        levels = float(1 << self.bits)
        gain = min(max(parameters[GAIN], log(levels) - 30), log(levels) + 3)
        electrons = 10 * levels / exp(gain) + 10
        top = np.array([gain, 10 * levels, log(electrons), *[electrons] * (self.size - 3)])
        low = np.array([gain, -10 * levels, log(LEAST_NOISE) - gain, 0.0, *[1e-6] * (self.size - SHARED)])
        return np.clip(parameters, low, top)

    def maximise(self, start: Array, hold: Array | None = None, rounds: int = 60, enough: float = 1e-5) -> State:
        """Return the state of largest likelihood by damped Fisher scoring; `hold` [m] @ parameters keeps its value."""
        state = self.at(self.inside(start))
        damping = 1e-3
        for _ in range(rounds):
            gained, moved, damping = self._step(state, hold, damping)
            state = moved
            if gained < enough:
                break
        return state

    def _step(self, state: State, hold: Array | None, damping: float) -> tuple[float, State, float]:
        """Return the gain in log likelihood of one step, the state after it, and the damping of the next."""
        low = self.bounds(state.parameters)
        free = ~((state.parameters <= low) & (state.score <= 0)) & (np.diag(state.information) > 0)
        if hold is not None:
            free |= hold != 0  # a held parameter does not move alone
        scale = 1 / np.sqrt(np.maximum(np.diag(state.information)[free], 1e-12))
        matrix = state.information[np.ix_(free, free)] * np.outer(scale, scale)
        push = state.score[free] * scale
        normal = None if hold is None else hold[free] * scale
        while damping < 1e7:
            damped = matrix + damping * np.eye(len(push))
            solved = np.linalg.solve(damped, push)
            if normal is not None:
                along = np.linalg.solve(damped, normal)
                solved = solved - along * (normal @ solved) / (normal @ along)
            step = np.zeros(self.size)
            step[free] = scale * solved
            step *= min(1.0, 0.2 / max(abs(step[GAIN]), 1e-12), 1.0 / max(abs(step[NOISE]), 1e-12))
            trial = self.inside(state.parameters + step)
            held = hold is None or abs(hold @ (trial - state.parameters)) <= 1e-9 * max(abs(hold @ trial), 1e-9)
            moved = self.at(trial) if held else None
            if moved is not None and moved.value >= state.value:
                return moved.value - state.value, moved, max(damping / 10, 1e-9)
            damping = max(damping * 8, 1e-4)
        return 0.0, state, 1e-3

    def set_response(self, state: State) -> None:
        """Take d mean code / d light of every cell from a state: below the gain where codes saturate."""
        for panel, law in zip(self.panels, state.laws, strict=True):
            slope = law.by_mean @ panel.middle / exp(state.parameters[GAIN])
            self.response[list(panel.cells)] = np.clip(slope, 0.05, 2.0)

    def covariance(self, state: State) -> tuple[Array, Array]:
        """Return the inverse information and the sandwich, both [m, m]; parameters on a bound are left out as known."""
        pixels = 1 + max(int(cell.pixels.max()) for cell in self.cells)
        pushes = np.zeros((pixels, self.size))
        changes = self._by_excess(state.parameters)
        for panel, law, by_excess in zip(self.panels, state.laws, changes, strict=True):
            slope = self.slopes(panel, law, state.parameters) / law.shares
            for r, i in enumerate(panel.cells):
                cell = self.cells[i]
                bins = panel.place[cell.codes]
                tables = slope[:, r]
                terms = np.stack([table[bins].sum(axis=0) for table in tables])
                if not self.dark[i]:
                    terms += by_excess[:, r, None] * (cell.influence / cell.influence.size)
                    pushes[cell.pixels, self.own[i]] += terms[SHARED]
                pushes[cell.pixels, :SHARED] += terms[:SHARED].T
        scale = 1 / np.sqrt(np.maximum(np.diag(state.information), 1e-300))
        matrix = state.information * np.outer(scale, scale)
        inverse = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True) * np.outer(scale, scale)
        meat = pushes.T @ pushes * (pixels / max(pixels - self.size, 1))
        return inverse, inverse @ meat @ inverse

    def _by_excess(self, parameters: Array) -> list[Array]:
        """Return the derivative of the score by the excess of every cell, per panel [5, cells]."""
        step = 1e-3 * np.array([max(cell.variance, 1e-6) for cell in self.cells])
        found = []
        for sign in (1, -1):
            excess = self.excess + sign * step
            laws = self.laws(parameters, excess)
            slopes = [
                np.einsum("qrb,rb->qr", self.slopes(panel, law, parameters, excess), panel.counts / law.shares)
                for panel, law in zip(self.panels, laws, strict=True)
            ]
            found.append(slopes)
        return [
            (more - less) / (2 * step[list(panel.cells)]) for panel, more, less in zip(self.panels, *found, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Fit:
    """The maximum of the likelihood with the covariance of its parameters."""

    likelihood: Likelihood
    state: State
    inverse: Array  # [m, m], inverse information
    covariance: Array  # [m, m], sandwich

    @property
    def gain(self) -> float:
        return exp(self.state.parameters[GAIN])

    @property
    def noise(self) -> float:
        return exp(self.state.parameters[NOISE])


def fit_cells(cells: Sequence[Cell], exposures: Sequence[float], darks: int, bits: int) -> Fit:
    """Fit all cells, from the likeliest of several starts; `exposures` of the stacks, darks first."""
    longest = max(exposures[:darks])
    share = np.array([exposures[cell.stack] / longest for cell in cells])
    starts = starts_of(cells, share, darks)
    first = starts.points[0].copy()
    first[NOISE] = log(starts.noise)
    likelihood = Likelihood(cells, exposures, darks, bits, first, hidden=starts.hidden)
    values = [likelihood.value(likelihood.inside(point)) for point in starts.points]
    count = STARTS if bits > FEW_BITS else MORE_STARTS
    rough = [likelihood.maximise(point, rounds=12, enough=0.1) for point in distinct(starts.points, values, count)]
    best = max(rough, key=lambda state: state.value)
    likelihood.set_response(best)
    best = likelihood.maximise(best.parameters)
    hidden = starts.hidden and exp(best.parameters[NOISE]) > HIDDEN
    likelihood = Likelihood(cells, exposures, darks, bits, best.parameters, hidden=hidden)
    return refined(likelihood, best)


def refined(likelihood: Likelihood, start: State) -> Fit:
    """Return the fit at the maximum near a state."""
    best = start
    for _ in range(2):
        likelihood.set_response(likelihood.at(best.parameters))
        best = likelihood.maximise(best.parameters, enough=1e-10)
    return Fit(likelihood, best, *likelihood.covariance(best))
