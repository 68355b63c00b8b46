"""Measures the speed of qsim, visionsim and Pyxel at drawing frames from the same light, in one run.

python benchmarks/neighbours.py VISIONSIM_PYTHON PYXEL_PYTHON    # interpreters of environments that have these packages

Every program draws frames of 512 x 512 pixels from the light of a photograph, 3.25 photons per pixel, on one thread, in
its own process: single-photon frames of 1 bit, and frames of 4 bits with shot noise, dark current, read noise and an
ADC (Pyxel's ADC has at least 4 bits). The result is the least processor time of seven frames. visionsim draws 1-bit
frames only. Pyxel's pipeline is that of its models: shot noise, photons to electrons, dark current, collection,
measurement, read noise, amplifier, ADC.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from skimage import data

from qsim.tables import markdown_table

CLOCK = """
import json, sys, time
import numpy as np

photons = np.load(sys.argv[1])

def least(draw):
    spent = []
    for _ in range(8):
        started = time.process_time()
        draw()
        spent.append(time.process_time() - started)
    return min(spent[1:])
"""
QSIM = """
from qsim import QIS, BinarySPAD, Key

def seconds(sensor, engine):
    frames = iter(range(100))
    return least(lambda: sensor.sample(photons, 5e-4, key=Key(0, 0).at(next(frames)), engine=engine))

one, four = BinarySPAD(0.8, 1.6, bits=1), QIS(0.8, 1.6, 0.2, bits=4)
for engine in ("reference", "fast"):
    print(json.dumps([f"qsim, {engine}", seconds(one, engine), seconds(four, engine)]))
"""
VISIONSIM = """
import visionsim
from visionsim.emulate.spc import emulate_spc

rng = np.random.default_rng(0)
print(json.dumps([f"visionsim {visionsim.__version__}", least(lambda: emulate_spc(photons, 0.8, rng)), None]))
"""
PYXEL = """
import pyxel
from pyxel.detectors import CMOS, Characteristics, ChargeToVoltSettings, CMOSGeometry, Environment
from pyxel.models.charge_collection import simple_collection
from pyxel.models.charge_generation import simple_conversion, simple_dark_current
from pyxel.models.charge_measurement import output_node_noise, simple_measurement
from pyxel.models.photon_collection import shot_noise
from pyxel.models.readout_electronics import simple_adc, simple_amplifier

rows, columns = photons.shape
volts = 1e-6  # per electron
camera = CMOS(
    CMOSGeometry(row=rows, col=columns), Environment(temperature=300.0),
    Characteristics(
        quantum_efficiency=0.8, charge_to_volt=ChargeToVoltSettings(volts), pre_amplification=1.0,
        full_well_capacity=1000, adc_bit_resolution=4, adc_voltage_range=(0.0, 15 * volts),
    ),
)

def frame():
    camera.empty()
    camera.set_readout(times=[5e-4])
    camera.time_step = 5e-4
    camera.photon.array = photons.copy()
    shot_noise(camera)
    simple_conversion(camera)
    simple_dark_current(camera, dark_rate=1.6)
    simple_collection(camera)
    simple_measurement(camera)
    output_node_noise(camera, std_deviation=0.2 * volts)
    simple_amplifier(camera)
    simple_adc(camera)
    assert 1.5 < camera.image.array.mean() < 3.5
    return camera.image.array

print(json.dumps([f"Pyxel {pyxel.__version__}", None, least(frame)]))
"""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


def measured(python: str, code: str, photons: Path) -> list[tuple[str, float | None, float | None]]:
    """Return (program, seconds of a 1-bit frame, seconds of a 4-bit frame) for each line that the code prints."""
    run = [python, "-c", CLOCK + code, str(photons)]
    done = subprocess.run(run, capture_output=True, text=True, check=True, env=os.environ | ONE_THREAD)
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def main(visionsim: str, pyxel: str) -> None:
    light = data.camera().astype(float)
    with tempfile.TemporaryDirectory() as folder:
        photons = Path(folder) / "photons.npy"
        np.save(photons, light * (3.25 / light.mean()))
        rows = [
            row
            for python, code in ((sys.executable, QSIM), (visionsim, VISIONSIM), (pyxel, PYXEL))
            for row in measured(python, code, photons)
        ]

    def speed(seconds: float | None) -> str:
        return "–" if seconds is None else f"{light.size / seconds / 1e6:.3g}"

    cells = [[name, speed(one), speed(four)] for name, one, four in rows]
    print("\n".join(markdown_table(cells, ["program", "1 bit [10⁶ pixels/s]", "4 bits [10⁶ pixels/s]"])))


if __name__ == "__main__":
    main(*sys.argv[1:])
