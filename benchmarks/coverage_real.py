"""Calibrates recordings of real sensors, and frames that were made elsewhere; adds a table to docs/results/coverage.md.

    python benchmarks/coverage_real.py DATA CASES      # the folders of both; see docs/results/coverage.md

DATA holds hazelnut_counts_TYX.npy (photon counts of one detector, BSD-3-Clause, napari-flim-phasor-plotter) and
spad512_darkcounts_YX.npy (dark counts of 50 x 50 SPADs, MIT, SP2T.jl). CASES holds cal_d1, d2, f1, f2 and f3.npy, of a
camera with gain 1, offset 20, 2 e- of read noise and one dark electron per exposure.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from coverage_page import store, write_page  # noqa: E402

from qsim.calibration import Calibration, calibrate_qis, calibrate_spad, measure, measure_sums  # noqa: E402
from qsim.calibration.dead_time import calibrate_static  # noqa: E402

EXPOSURE = 1e-3  # s, as which the frames of the camera are stated
PLANE = 10.3e-6  # s, of the 7650 planes of the SPADs
PLANES = 7650
PIXEL = 6.33e-6  # s, for which the detector stays on a pixel


def camera(folder: Path, darks: tuple[tuple[str, float], ...]) -> Calibration:
    """Return the calibration of the camera from darks (name, exposures) and three flats."""

    def stack(name: str, times: float, photons: float | None):  # type: ignore[no-untyped-def]
        return measure([np.load(folder / f"cal_{name}.npy")], bits=8, exposure=times * EXPOSURE, photons=photons)

    taken = [stack(name, times, 0.0) for name, times in darks]
    return calibrate_qis(taken, [stack(name, 1.0, None) for name in ("f1", "f2", "f3")], bits=8)


def rows(data: Path, cases: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yield (recording, value, found, known)."""
    known = {"gain": "1", "offset": "20", "read_noise": "2", "dark_current": f"{1 / EXPOSURE:g}"}
    for what, darks in (("one dark exposure", (("d1", 1.0),)), ("two dark exposures", (("d1", 1.0), ("d2", 3.0)))):
        found = camera(cases, darks)
        for name, truth in known.items():
            yield f"camera, {what}", name, str(found.values[name]), truth
    ones = np.rint(-np.expm1(-np.load(data / "spad512_darkcounts_YX.npy")) * PLANES)
    found = calibrate_spad([measure_sums([ones], planes=PLANES, exposure=PLANE, photons=0.0)], [], bits=1)
    body = float(ones[ones < 3 * np.median(ones)].mean()) / PLANES / PLANE
    above = int(np.count_nonzero(ones > 10 * np.median(ones)))
    yield "SPADs", "dark_count_rate_median", str(found.values["dark_count_rate_median"]), f"mean of the body {body:.4g}"
    yield "SPADs", "hot_pixels", str(found.values["hot_pixels"]), f"{above} above 10 medians"
    counts = np.load(data / "hazelnut_counts_TYX.npy").astype(int)
    found = calibrate_static(counts, bits=8, exposure=PIXEL)
    yield "photon counts", "dead_time", str(found.values["dead_time"]), "4.0e-09 ± 0.3e-09"


if __name__ == "__main__":
    store("coverage_real", [list(row) for row in rows(Path(sys.argv[1]), Path(sys.argv[2]))])
    write_page()
