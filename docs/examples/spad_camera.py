"""
# My SPAD camera

Darks and flats of a camera of binary planes become a sensor with its hot pixels, and a recording becomes video. The
camera is simulated here by a few lines of NumPy; [the page](../spad_camera.md) does the same by commands.
"""

# %%
# The camera: 40 % efficiency, 40 dark counts per second, and 1 % of hot pixels, which fire in up to every plane.

import warnings

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter, shift

import quiver
from qsim import BinarySPAD, calibrate_spad
from qsim.calibration.frame_statistics import measure

side = 128  # tests: 32
count = 420  # tests: 140
exposure = 1e-4  # s, of a plane
rng = np.random.default_rng(0)
dark = np.full((side, side), 0.004)
broken = rng.random(dark.shape) < 0.01
dark[broken] += rng.uniform(0.1, 3, broken.sum())


def planes(light):
    """Binary planes [T, H, W] of photons per pixel and plane [T, H, W]."""
    return (rng.random(light.shape) < -np.expm1(-(0.4 * light + dark))).astype(np.uint8)


# %%
# Darks and flats: the measured efficiency, the dark rate, and the hot pixels.

darks = measure([planes(np.zeros((2 * count, side, side)))], bits=1, exposure=exposure, photons=0.0)
flats = measure([planes(np.full((2 * count, side, side), 0.8))], bits=1, exposure=exposure, photons=0.8)
found = calibrate_spad([darks], [flats], bits=1)
for name in ("pde_fill", "dark_count_rate_good", "hot_pixels"):
    print(f"{name:20} {found.values[name]}")
hot = found.maps["hot_pixels"]
print(f"{(hot & broken).sum()} of {broken.sum()} hot pixels are found, {(hot & ~broken).sum()} others")

# %%
# A recording of a moving picture, and its video: seven planes make a code. Without the map, a scan finds the pixels
# that do not follow their neighbours; without both, mergenet takes them for stars.

picture = gaussian_filter(rng.standard_normal((side, side)), 2, mode="wrap") > 0.02
picture = gaussian_filter(0.2 + 1.2 * picture, 0.8, mode="wrap")
light = np.stack([shift(picture, (0, 0.07 * t), order=1, mode="grid-wrap") for t in range(count)])
recording = planes(light)
sensor = BinarySPAD(found.values["pde_fill"].value, found.values["dark_count_rate_good"].value)
videos = {}
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of each restoration: how many pixels were found
    for title, settings in {"as it is": {"scan": False}, "scan": {}, "map": {"defects": hot}}.items():
        videos[title] = quiver.restore(recording, "mergenet", sensor=sensor, exposure=exposure, planes=7, **settings)

# %%
middle = count // 14
truth = 7 * light[7 * middle + 3]
shown = {"one plane": recording[7 * middle], "sum of 7": recording[7 * middle : 7 * middle + 7].sum(axis=0)}
shown |= {title: video[middle] for title, video in videos.items()} | {"truth": truth}
figure, axes = plt.subplots(2, 3, figsize=(9, 6.4), layout="constrained")
for axis, (title, image) in zip(axes.flat, shown.items(), strict=True):
    error = np.sqrt(np.mean((image - truth) ** 2))
    axis.imshow(image, cmap="gray", vmin=0, vmax={"one plane": 1, "sum of 7": 5}.get(title, 11))
    axis.set_title(f"{title}, rms error {error:.2f}" if title in videos else title)
    axis.axis("off")
