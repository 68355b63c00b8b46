"""
# Training a network

A recipe makes a data set, and one loop trains any network on it. Two minutes are enough to see the PSNR rise.
"""

# %%
# Three clips: two to train on, one to validate. Frames are small here; the recipes of the library make larger ones.

import matplotlib.pyplot as plt
import torch

from qsim.dataset import generate, recipe
from qsim.dataset.generation import Options
from quiver.model.presets import build
from quiver.training import Settings, train

side = 64  # tests: 32
steps = 60  # tests: 2
description = f"""
[recipe]
name = "tiny"
frames = 12
height = {side}
width = {side}
psnr = 26.0

[[scenes]]
family = "fan"
count = 2
speed = 6.0

[[scenes]]
family = "tumble"
speed = 6.0
count = 1
split = "val"

[[streams]]
sensor = "quiver-physical"
bits = 3
ppp = 3.25
"""
summary = generate(recipe.parse(description), "tiny", Options(workers=0))
print(f"{summary.done} of {summary.jobs} clips")

# %%
# Sensor, bits and light are those of the data set's streams. `unet` is a plain network; `quiver` is
# trained alike.

torch.manual_seed(0)
settings = Settings(
    "tiny", "run", network="unet", steps=steps, batch=2, crop=32, validate_every=max(steps // 6, 1), threads=1
)
state = train(build("unet"), settings, progress=False)

# %%
# The folder holds the settings, the best weights and the history. The same call resumes an interrupted run.

rows = [row for row in state.history if "psnr" in row]
print(f"{len(rows)} validations; best {max(row['psnr'] for row in rows):.2f} dB")
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
axis.plot([row["step"] for row in rows], [row["psnr"] for row in rows], "o-")
axis.set(xlabel="step", ylabel="PSNR on the validation clip [dB]")
