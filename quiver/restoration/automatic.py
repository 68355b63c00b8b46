"""Chooses the method of a stream: MergeNet, or a classical method where that is better.

    sensor, bits, light -> nearest measured cell in the weights file (domain.py) -> method
    stream -> a trial of the network and the classical methods on a few pieces (trial.py) -> method, if it differs

and one line that says why. The cells are averages over clips of several speeds. A trial decides for the stream itself,
where the stream is long enough that the trial costs little beside it, and where it is sure.
"""

from __future__ import annotations

from collections.abc import Iterable

from quiver.baselines import exposures
from quiver.data.codes import Codes, light_of
from quiver.restoration.domain import place_of
from quiver.restoration.interface import AUTO, RestoreOptions, Restorer
from quiver.restoration.mosaics import by_colour
from quiver.restoration.restorers import restorer
from quiver.restoration.trial import COST, FEWEST, affordable, tried

NETWORK = "mergenet"
RIVALS = ("qbp-bm3d", "qbp-bm3d:5")  # classical methods that are tried beside the network


def chosen(
    name: str, codes: Codes, options: RestoreOptions | None = None, cost: float = COST
) -> tuple[Restorer, str | None]:
    """Return the method of this name for a stream; for `auto` the chosen one, and a line that says why.

    A trial costs at most this share of the restoration.
    """
    method, why = chosen_for_all(name, [codes], options)
    if name != AUTO or codes.shares is not None:
        return method, why
    return _tried(method, codes, options, cost, str(why))


def chosen_for_all(
    name: str, streams: Iterable[Codes], options: RestoreOptions | None = None
) -> tuple[Restorer, str | None]:
    """Return the method of this name for several streams, as `chosen`, with the line of the first.

    `ValueError` with the names of streams for which `auto` chooses different methods.
    """
    if name != AUTO:
        return restorer(name, options), None
    known: dict[str, Restorer] = {}
    streams_of: dict[str, list[str]] = {}
    lines = []
    for codes in streams:
        best, why = _best(codes, known, options)
        streams_of.setdefault(best, []).append(codes.name)
        lines.append(f"auto: {best}; {why}")
    if len(streams_of) > 1:
        found = "; ".join(f"{best} for {_listed(names)}" for best, names in streams_of.items())
        raise ValueError(f"auto chooses different methods: {found}; name one of them with method=")
    best = next(iter(streams_of))
    return known.get(best) or restorer(best, options), lines[0]


def _tried(
    first: Restorer, codes: Codes, options: RestoreOptions | None, cost: float, why: str
) -> tuple[Restorer, str]:
    """Return the best method of a trial on a stream, and why: `first` where there is none, or where it is not sure."""
    if codes.colour is not None:
        return first, f"{why}; not tried behind colour filters"
    names = dict.fromkeys((first.name, NETWORK, *RIVALS))
    methods = {name: first if name == first.name else restorer(name, options) for name in names}
    pieces = affordable(codes, list(methods.values()), cost)
    if pieces < FEWEST:
        return first, f"{why}; too few frames or pixels for a trial on the stream"
    try:
        verdict = tried(codes, list(methods.values()), pieces)
    except ValueError:  # a mean code that does not rise with light
        return first, f"{why}; its sensor allows no trial"
    if verdict.best == first.name:
        return first, f"{why}; {verdict}"
    return methods[verdict.best], f"auto: {verdict.best}; {verdict}; {why.removeprefix('auto: ')}"


def _best(codes: Codes, known: dict[str, Restorer], options: RestoreOptions | None) -> tuple[str, str]:
    """Return the name of the best method for a stream, and why. The network is loaded once, into `known`.

    Each colour of a mosaic is restored alone: one for which the network was measured to be worse decides.
    """
    if codes.shares is not None:
        if exposures.table_bytes(codes.shares, codes.sensor, codes.exposure) > exposures.TABLE_BYTES:
            return (
                "moment",
                f"the codes have different exposures, and {codes.sensor.bits} bit are too many for likelihood",
            )
        return "likelihood", "the codes have different exposures"
    network = known.get(NETWORK) or known.setdefault(NETWORK, restorer(NETWORK, options))
    domain = None if network.scope is None else network.scope.domain
    measured = ""
    unknown = ""
    for part in by_colour(codes):
        ppp = light_of(part)
        cell = None if domain is None else domain.nearest(place_of(part.sensor, part.exposure, ppp))
        if cell is None:
            unknown = unknown or f"nothing was measured near {part.sensor.bits} bit, {ppp:.3g} PPP"
        elif not cell.wins:
            return cell.classical, f"measured at {cell.name}: {cell.scores}"
        else:
            measured = measured or f"measured at {cell.name}: {cell.scores}"
    return NETWORK, unknown or measured


def _listed(names: list[str]) -> str:
    """Return up to three names, and how many more there are."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
