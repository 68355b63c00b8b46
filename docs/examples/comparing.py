"""
# Comparing methods over light

Which method is best depends on the light. Every method sees the same codes, because noise is keyed by seed, clip and
frame.
"""

# %%
# One clip, sensed at four light levels. The scores of a real comparison come from many scenes: `quiver evaluate`
# makes its table with intervals.

import matplotlib.pyplot as plt

import qsim
import quiver

side = 96  # tests: 16
lights = (0.5, 2.0, 8.0, 26.0)  # tests: (2.0, 8.0)
methods = ("naive:11", "moment:3", "transform-denoise", "mergenet")  # tests: ("naive:11", "moment:3")
clip = qsim.render("text", frames=11, height=side, width=side, speed=3, psnr=34)

# %%
scores = {method: [] for method in methods}
for ppp in lights:
    stream = clip.sense("quiver-physical", bits=3, ppp=ppp)
    for method in methods:
        scores[method].append(quiver.score(quiver.restore(stream, method), stream).psnr_matched)
print(f"{'PPP':20}" + "".join(f"{ppp:8g}" for ppp in lights))
for method, found in scores.items():
    print(f"{method:20}" + "".join(f"{value:8.2f}" for value in found))

# %%
# The network has one set of weights for all light. Where a classical method was measured to be better, `quiver.restore`
# warns.

figure, axis = plt.subplots(figsize=(6, 3.4), layout="constrained")
for method, found in scores.items():
    axis.semilogx(lights, found, "o-", label=method)
axis.set(xlabel="photons per pixel", ylabel="PSNR after the best factor [dB]")
axis.legend()
