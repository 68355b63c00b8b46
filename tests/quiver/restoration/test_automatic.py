"""The method `auto`: what was measured to be better at a stream's sensor, depth and light, and a line that says why."""

from dataclasses import replace

import numpy as np
import pytest

from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.devices import quiver_physical
from quiver.cli.program import main
from quiver.data.codes import array_codes
from quiver.restoration import automatic
from quiver.restoration.domain import Cell, Domain, Scope, place_of
from quiver.restoration.restorers import restorer

EXPOSURE = 5e-4


def stream(ppp, bits=3):
    codes = np.zeros((2, 8, 8), np.uint8)
    return replace(array_codes(codes, quiver_physical(ppp, bits), EXPOSURE), ppp=ppp)


@pytest.fixture
def measured(monkeypatch):
    """Two cells: the network wins at 3.25 PPP and loses at 26."""
    cells = tuple(
        Cell("quiver-physical", ppp, place_of(quiver_physical(ppp), EXPOSURE, ppp), network, "qbp", 25.0)
        for ppp, network in ((3.25, 26.0), (26.0, 24.0))
    )

    def found(name, options=None):
        method = restorer(name, options)
        return replace(method, scope=Scope(Domain(cells, {}), ())) if name == "mergenet" else method

    monkeypatch.setattr(automatic, "restorer", found)


@pytest.mark.parametrize(
    ("ppp", "bits", "name", "said"),
    [
        (
            3.25,
            3,
            "mergenet",
            "auto: mergenet; measured at quiver-physical, 3 bit, 3.25 PPP: qbp 25.0 dB, network 26.0",
        ),
        (26.0, 3, "qbp", "auto: qbp; measured at quiver-physical, 3 bit, 26 PPP: qbp 25.0 dB, network 24.0 dB"),
        (26.0, 5, "mergenet", "auto: mergenet; nothing was measured near 5 bit, 26 PPP"),
    ],
)
def test_the_better_method_is_chosen_and_named(measured, ppp, bits, name, said):
    method, line = automatic.chosen("auto", stream(ppp, bits))
    assert method.name == name
    assert line.startswith(said)


def test_a_difference_that_few_clips_cannot_tell_decides_nothing():
    """The cell of one SPAD plane at 1 PPP: 0.003 dB on three short clips gave streams to a method that loses 1 dB."""
    place = place_of(quiver_physical(3.25), EXPOSURE, 3.25)
    assert Cell("spad-320x240", 1.0, place, 18.092, "qbp-bm3d:5", 18.095).wins
    assert not Cell("spad-320x240", 1.0, place, 18.0, "qbp-bm3d:5", 18.095).wins


def test_a_named_method_is_taken_without_a_word():
    method, line = automatic.chosen("moment:3", stream(3.25))
    assert (method.name, line) == ("moment:3", None)


@pytest.mark.parametrize("ppp", [0.5, 3.25, 26.0])
def test_shipped_weights_decide_by_what_was_measured(ppp):
    method, line = automatic.chosen("auto", stream(ppp))
    cells = restorer("mergenet").scope.domain.cells
    cell = next(c for c in cells if (c.sensor, c.place.bits, c.ppp) == ("quiver-physical", 3, ppp))
    assert method.name == ("mergenet" if cell.wins else cell.classical)
    assert f"measured at quiver-physical, 3 bit, {ppp:g} PPP" in line


@pytest.mark.parametrize(
    "command",
    [
        "restore c.npy --sensor quiver-paper -o r.npy --method auto:5",
        "evaluate D -o e --methods naive,auto",
        "bench -o b --methods auto --size 16x16",
    ],
)
def test_other_commands_say_what_auto_is_for(capsys, tiny_dataset, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    np.save("c.npy", np.zeros((3, 16, 16), np.uint8))
    assert main(command.replace("D", str(tiny_dataset)).split()) == 2
    assert "`auto` chooses the method of one stream, for `quiver restore`" in capsys.readouterr().err


def test_streams_with_one_best_method_share_it_and_others_are_named(measured):
    names = {3.25: "day", 3.0: "dusk", 26.0: "noon"}
    dim, dimmer, bright = (replace(stream(ppp), name=name) for ppp, name in names.items())
    method, line = automatic.chosen_for_all("auto", [dim, dimmer])
    assert method.name == "mergenet"
    assert automatic.chosen("auto", dim)[1].startswith(line)
    with pytest.raises(ValueError, match="different methods: mergenet for day, dusk; qbp for noon; name one of them"):
        automatic.chosen_for_all("auto", [dim, bright, dimmer])
    assert automatic.chosen_for_all("moment:3", [dim, bright])[0].name == "moment:3"


def test_the_worst_colour_of_a_mosaic_decides(measured):
    """White pixels have three times the light of the others, at which the network loses."""
    mosaic = replace(stream(26.0), ppp=26.0 / 3, colour=ColourFilter(MASKS["rgbw"]))
    assert automatic.chosen("auto", mosaic)[0].name == "qbp"
    assert automatic.chosen("auto", replace(mosaic, colour=None))[0].name == "mergenet"
