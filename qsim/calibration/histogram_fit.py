"""Fits the histograms of a camera's dark and flat frames by maximum likelihood.

Of bright cells mean and variance are fitted (moment_law.py), of the others the histogram (code_law.py): by a sum over
electrons, or by an Edgeworth series if a cell is both bright and clipped.

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
from qsim.calibration.moment_law import BRIGHT, MomentLaw, by_moments
from qsim.calibration.starts import distinct, first_gain, starts_of

GAIN, OFFSET, NOISE, DARK = range(4)
SHARED = 4  # parameters before those of the cells
FINEST = 2.0  # bins in one standard deviation of the read noise
MOST_BINS = 800
STARTS = 10  # that are followed
ROUGH = 20.0  # of the log likelihood, by which a rough maximum may be worse and is followed
MOST_MODES = 3  # that are kept
NEARLY = 5.0  # by which a maximum may be worse and is another possible answer
APART = 0.1  # of the quadratic form of the information, between two maxima
BESIDE = (-2, -1, 1, 2)  # e- of the brightest cell whose histogram is used, by which a gain is tried beside the best
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

    def __init__(self, cells: Sequence[Cell], exposures: Sequence[float], darks: int, bits: int, start: Array) -> None:
        self.cells = tuple(cells)
        self.bits = bits
        self.darks = darks
        longest = max(exposures[:darks])
        self.share = np.array([exposures[c.stack] / longest if c.stack < darks else 0.0 for c in cells])
        self.dark = np.array([c.stack < darks for c in cells])
        self.excess = np.array([c.excess for c in cells])
        self.response = np.ones(len(cells))  # d mean code / d light, relative to the gain
        self.own = np.where(self.dark, -1, SHARED - 1 + np.cumsum(~self.dark))
        self.size = SHARED + int(np.count_nonzero(~self.dark))
        gain = first_gain(cells)
        self.simple = np.array([i for i, cell in enumerate(cells) if by_moments(cell, gain, bits)], dtype=int)
        self.moments = MomentLaw([cells[i] for i in self.simple])
        self.panels = tuple(self._panels(start))

    def _panels(self, start: Array) -> list[Panel]:
        """Return one panel of all dim cells, and those of the bright ones: one per stack."""
        # Bins are as fine as the law has structure: a part of the read noise, or of a bright cell's spread.
        step = exp(start[GAIN] + start[NOISE]) / FINEST
        electrons = self.means(start)
        rest = [i for i in range(len(self.cells)) if i not in self.simple]
        dim = [i for i in rest if electrons[i] <= BRIGHT]
        together: dict[int, list[int]] = {}
        for i in rest:
            if i not in dim:
                together.setdefault(self.cells[i].stack, []).append(i)
        panels = [self._panel(dim, step, smooth=False)] if dim else []
        for members in together.values():
            step = sqrt(min(self.cells[i].variance for i in members)) / 5
            panels.append(self._panel(members, step, smooth=True))
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
        gain = exp(parameters[GAIN])
        offset = float(parameters[OFFSET])
        noise = exp(parameters[NOISE])
        mean = self.means(parameters)
        spread = self.spreads(gain, excess)
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

    def beside(self, parameters: Array) -> list[Array]:
        """Return parameters of other gains, at which the brightest cell has some whole electrons more or less."""
        electrons = self.means(parameters)
        most = max((float(electrons[list(panel.cells)].max()) for panel in self.panels), default=0.0)
        found = []
        for change in BESIDE:
            # A comb of single electrons fits nearly as well with one tooth more or
            # less: such gains are maxima of their own, and each is tried.
            factor = 1 + change / max(most, 4.0)
            other = parameters.copy()
            other[GAIN] -= log(factor)
            other[SHARED:] *= factor
            found.append(other)
        return found

    def value(self, parameters: Array) -> float:
        """Return the log likelihood."""
        shapes = sum(
            float(np.sum(panel.counts * np.log(law.shares)))
            for panel, law in zip(self.panels, self.laws(parameters), strict=True)
        )
        return shapes + self.moments.value(*self.moments_at(parameters))

    def moments_at(self, parameters: Array) -> tuple[Array, Array]:
        """Return mean and variance of the cells of which nothing else is used."""
        gain = exp(parameters[GAIN])
        offset = float(parameters[OFFSET])
        noise = exp(parameters[NOISE])
        return self.moments.laws(gain, offset, noise, self.means(parameters)[self.simple])

    def moment_slopes(self, parameters: Array) -> tuple[Array, Array]:
        """Return the derivatives of both by ln gain, offset, ln read noise, dark and own electrons: [5, cells]."""
        electrons = self.means(parameters)[self.simple]
        share = self.share[self.simple]
        own = ~self.dark[self.simple]
        of_mean, of_variance = self.moments.slopes(exp(parameters[GAIN]), exp(parameters[NOISE]), electrons)
        parts = np.stack([np.ones_like(share), np.ones_like(share), np.ones_like(share), share, own])
        rows = [0, 1, 2, 3, 3]
        return of_mean[rows] * parts, of_variance[rows] * parts

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
        value = 0.0
        score = np.zeros(self.size)
        information = np.zeros((self.size, self.size))

        def add(members: Array, pushes: Array, fisher: Array) -> None:
            """Add the score [5, cells] and the information [5, 5, cells] of cells."""
            score[:SHARED] += pushes[:SHARED].sum(axis=1)
            information[:SHARED, :SHARED] += fisher[:SHARED, :SHARED].sum(axis=2)
            flat = self.own[members] >= 0
            k = self.own[members][flat]  # every cell of a flat has a parameter, so no k is there twice
            score[k] += pushes[SHARED, flat]
            information[k, k] += fisher[SHARED, SHARED, flat]
            information[:SHARED, k] += fisher[:SHARED, SHARED, flat]
            information[k, :SHARED] += fisher[:SHARED, SHARED, flat].T

        for panel, law in zip(self.panels, laws, strict=True):
            slope = self.slopes(panel, law, parameters)
            value += float(np.sum(panel.counts * np.log(law.shares)))
            weight = panel.counts.sum(axis=1)[:, None] / law.shares
            # Fisher's information of a multinomial law: n sum over the bins of dp_b / dq dp_b / dr / p_b.
            fisher = np.einsum("qrb,prb->qpr", slope * weight, slope, optimize=True)
            add(np.array(panel.cells), np.einsum("qrb,rb->qr", slope, panel.counts / law.shares), fisher)
        if self.simple.size:
            mean, variance = self.moments_at(parameters)
            slopes = self.moment_slopes(parameters)
            value += self.moments.value(mean, variance)
            add(
                self.simple,
                self.moments.score(mean, variance, *slopes),
                self.moments.information(variance, *slopes),
            )
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
        # A parameter at its bound that would leave it does not move (active set).
        free = ~((state.parameters <= low) & (state.score <= 0)) & (np.diag(state.information) > 0)
        if hold is not None:
            free |= hold != 0  # a held parameter does not move alone
        # Parameters have other units and sizes: scaled to an information of
        # 1, one damping serves all (Levenberg and Marquardt).
        scale = 1 / np.sqrt(np.maximum(np.diag(state.information)[free], 1e-12))
        matrix = state.information[np.ix_(free, free)] * np.outer(scale, scale)
        push = state.score[free] * scale
        normal = None if hold is None else hold[free] * scale
        while damping < 1e7:
            damped = matrix + damping * np.eye(len(push))
            solved = np.linalg.solve(damped, push)
            if normal is not None:
                along = np.linalg.solve(damped, normal)
                # Lagrange: the part of the step that would change the held sum is
                # taken back along the direction that costs least.
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
                    # The spread of light within a cell is itself measured from
                    # its pixels, and each has an influence on it.
                    terms += by_excess[:, r, None] * (cell.influence / cell.influence.size)
                    pushes[cell.pixels, self.own[i]] += terms[SHARED]
                pushes[cell.pixels, :SHARED] += terms[:SHARED].T
        if self.simple.size:
            laws = self.moments_at(state.parameters)
            steepness = self.moment_slopes(state.parameters)
            for r, i in enumerate(self.simple):
                cell = self.cells[i]
                terms = self.moments.pushes(r, *laws, *steepness)
                pushes[cell.pixels, :SHARED] += terms[:SHARED].T
                if not self.dark[i]:
                    pushes[cell.pixels, self.own[i]] += terms[SHARED]
        scale = 1 / np.sqrt(np.maximum(np.diag(state.information), 1e-300))
        matrix = state.information * np.outer(scale, scale)
        inverse = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True) * np.outer(scale, scale)
        # The sandwich (Huber, 1967): covariance of the score by pixels, between two inverse
        # informations. It holds though the frames of a pixel are not independent.
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
    modes: tuple[State, ...]  # other maxima of nearly the same likelihood

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
    starts = starts_of(cells, share, darks, _brightest(cells, darks, bits))
    first = starts.points[0].copy()
    first[NOISE] = log(starts.noise)
    likelihood = Likelihood(cells, exposures, darks, bits, first)
    values = [likelihood.value(likelihood.inside(point)) for point in starts.points]
    rough = [likelihood.maximise(point, rounds=12, enough=0.1) for point in distinct(starts.points, values, STARTS)]
    best = max(rough, key=lambda state: state.value)
    beside = [likelihood.maximise(point, rounds=12, enough=0.1) for point in likelihood.beside(best.parameters)]
    best = max([best, *beside], key=lambda state: state.value)
    likelihood.set_response(best)
    best = likelihood.maximise(best.parameters)
    likelihood = Likelihood(cells, exposures, darks, bits, best.parameters)
    return refined(likelihood, best, [*rough, *beside])


def _brightest(cells: Sequence[Cell], darks: int, bits: int) -> float:
    """Return the most codes above the dark level of a cell whose histogram is used."""
    gain = first_gain(cells)
    used = [cell.mean for cell in cells if cell.stack >= darks and not by_moments(cell, gain, bits)]
    return max(used, default=0.0) - min(cell.mean for cell in cells)


def refined(likelihood: Likelihood, start: State, others: Sequence[State] = ()) -> Fit:
    """Return the fit at the maximum near a state, with those of the other states that are nearly as likely."""
    best = start
    for _ in range(2):
        likelihood.set_response(likelihood.at(best.parameters))
        best = likelihood.maximise(best.parameters, enough=1e-10)
    modes: list[State] = []
    for other in sorted(others, key=lambda state: state.value, reverse=True):
        if len(modes) == MOST_MODES:
            break
        if likelihood.value(other.parameters) < best.value - ROUGH:
            continue
        state = likelihood.maximise(other.parameters, enough=1e-5)
        if state.value > best.value - NEARLY and all(_differ(state, known) for known in (best, *modes)):
            modes.append(state)
    return Fit(likelihood, best, *likelihood.covariance(best), tuple(modes))


def _differ(one: State, other: State) -> bool:
    """Return whether two maxima are not the same one."""
    gap = one.parameters[:SHARED] - other.parameters[:SHARED]
    return float(gap @ one.information[:SHARED, :SHARED] @ gap) > APART
