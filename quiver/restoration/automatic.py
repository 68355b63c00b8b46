"""Chooses the method of a stream: MergeNet, or a classical method where that was measured to be better.

    sensor, bits, light -> nearest measured cell in the weights file (domain.py) -> method, and one line that says why

The cells are averages over clips of several speeds. Motion does not decide: on the test clips, handing over exactly the
clips that a classical method restores better would gain 0.02 dB in the mean (docs/results/restorer.md).
"""

from __future__ import annotations

from quiver.data.codes import Codes
from quiver.restoration.domain import place_of
from quiver.restoration.domain_remarks import light_of
from quiver.restoration.interface import AUTO, RestoreOptions, Restorer
from quiver.restoration.restorers import restorer

NETWORK = "mergenet"
WITHOUT = "qbp-bm3d"  # without the packages of networks


def chosen(name: str, codes: Codes, options: RestoreOptions | None = None) -> tuple[Restorer, str | None]:
    """Return the method of this name for a stream; for `auto` the chosen one, and a line that says why."""
    if name != AUTO:
        return restorer(name, options), None
    if codes.shares is not None:
        return restorer("likelihood", options), "auto: likelihood; the codes have different exposures"
    try:
        network = restorer(NETWORK, options)
    except ModuleNotFoundError as error:
        return restorer(WITHOUT, options), f"auto: {WITHOUT}; {NETWORK} needs the package {error.name}"
    ppp = light_of(codes)
    domain = None if network.scope is None else network.scope.domain
    cell = None if domain is None else domain.nearest(place_of(codes.sensor, codes.exposure, ppp))
    if cell is None:
        return network, f"auto: {NETWORK}; nothing was measured near {codes.sensor.bits} bit, {ppp:.3g} PPP"
    best = NETWORK if cell.wins else cell.classical
    return (network if cell.wins else restorer(best, options)), f"auto: {best}; measured at {cell.name}: {cell.scores}"
