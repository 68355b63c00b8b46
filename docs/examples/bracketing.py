"""
# Bracketed exposures

A code of 3 bits is saturated at a few photons. Codes with short exposures in between see the highlights, and an
estimator that knows every exposure joins them.
"""

# %%
# Polished bodies, sensed with full exposures, and with exposures of 1, 1/4 and 1/16 in turn.

import matplotlib.pyplot as plt
import numpy as np

import qsim
import quiver

side, frames = 64, 12  # tests: 16, 6
clip = qsim.render("glossy", frames=frames, height=side, width=side, frame_rate=8000, psnr=32)
full = clip.sense("quiver-physical", ppp=12, bits=3, name="full")
bracketed = clip.sense("quiver-physical", ppp=12, bits=3, exposures=(1, 1 / 4, 1 / 16), name="bracketed")
print("exposures [us]:", np.round(bracketed.exposures[:6] * 1e6, 2))
print(f"saturated codes: {(full.codes() == 7).mean():.3f} of full, {(bracketed.codes() == 7).mean():.3f} of bracketed")

# %%
# Both are restored by the likelihood of all codes of a window. The truth is light, which no sensor clips.

truth = clip.stream("full").truth()
restored = {"full exposures": quiver.restore(full, "likelihood"), "bracketed": quiver.restore(bracketed, "likelihood")}
middle = frames // 2
figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
for axis, (name, video) in zip(axes, {"truth": truth, **restored}.items(), strict=True):
    axis.imshow(np.log10(video[middle] + 0.3), cmap="gray", vmin=0, vmax=np.log10(truth.max()))
    axis.set_title(f"{name}, log", fontsize=10)
    axis.axis("off")

# %%
# Where the light is beyond the white of the sensor, full exposures only tell that it is bright.

white = full.sensor.white(full.exposure)
bright = truth[middle] > 2 * white
for name, video in restored.items():
    error = np.median(np.abs(video[middle] / truth[middle] - 1)[bright])
    print(f"{name}: median error {100 * error:.0f} % in the {bright.mean():.1%} of pixels above twice white")
