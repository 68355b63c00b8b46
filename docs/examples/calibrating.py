"""
# Calibrating a camera

Dark and flat frames of a camera become a sensor with error bars. Here a simulated camera takes the frames, so that
the result can be compared.
"""

# %%
# A camera whose parameters we pretend not to know: 8 codes per electron and 0.25 electrons of read noise.

import matplotlib.pyplot as plt
import numpy as np

from qsim import QIS, Key, calibrate_qis
from qsim.calibration.frame_statistics import measure

side = 64  # tests: 32
secret = QIS(quantum_efficiency=0.8, dark_current=20.0, read_noise=0.25, bits=8, gain=8.0, offset=40.0)


def record(photons: float, exposure: float, number: int) -> np.ndarray:
    return secret.sample(np.full((20, side, side), photons), exposure, key=Key(seed=1, clip=number))


darks = {1e-3: record(0.0, 1e-3, 0), 50e-3: record(0.0, 50e-3, 1)}
flats = {photons: record(photons, 1e-3, 2 + n) for n, photons in enumerate((0.6, 2.5, 7.5))}

# %%
# The histogram of a dim flat shows single electrons. The calibration fits all histograms together by maximum
# likelihood.

figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.hist(flats[2.5].ravel(), bins=np.arange(30, 110) - 0.5)
axis.set(xlabel="code", ylabel="pixels")

# %%
# Every value has a 95 % interval; the true value stands behind it.

found = calibrate_qis(
    [measure([frames], bits=8, exposure=exposure, photons=0) for exposure, frames in darks.items()],
    [measure([frames], bits=8, exposure=1e-3, photons=None) for frames in flats.values()],
    bits=8,
)
for name in ("gain", "offset", "read_noise", "dark_current"):
    print(f"{name:13} {found.values[name]}   true {getattr(secret, name):g}")
