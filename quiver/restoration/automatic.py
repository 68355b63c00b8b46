"""Chooses the method of a stream: MergeNet, or a classical method where that was measured to be better.

    sensor, bits, light -> nearest measured cell in the weights file (domain.py) -> method, and one line that says why

The cells are averages over clips of several speeds. Motion does not decide: on the test clips, handing over exactly the
clips that a classical method restores better would gain 0.02 dB in the mean (docs/results/restorer.md).
"""

from __future__ import annotations

from collections.abc import Iterable

from quiver.baselines import exposures
from quiver.data.codes import Codes, light_of
from quiver.restoration.domain import place_of
from quiver.restoration.interface import AUTO, RestoreOptions, Restorer
from quiver.restoration.mosaics import by_colour
from quiver.restoration.restorers import restorer

NETWORK = "mergenet"


def chosen(name: str, codes: Codes, options: RestoreOptions | None = None) -> tuple[Restorer, str | None]:
    """Return the method of this name for a stream; for `auto` the chosen one, and a line that says why."""
    return chosen_for_all(name, [codes], options)


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
