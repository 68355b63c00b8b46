"""
# A data set on several machines

A job is one clip. It depends on no other job and writes the same bytes wherever it runs, so machines share a folder
and nothing else.
"""

# %%
# A recipe of six clips.

import matplotlib.pyplot as plt

import qsim
from qsim.dataset import generate, recipe
from qsim.dataset.generation import Options

side = 64  # tests: 16
made = recipe.parse(f"""
[recipe]
name = "shared"
frames = 3
height = {side}
width = {side}
psnr = 28.0

[[scenes]]
family = "pellets"
count = 3

[[scenes]]
family = "wires"
count = 3

[[streams]]
sensor = "spad-320x240"
bits = 1
ppp = 1.0
""")

# %%
# Two shards, as two tasks of an array job would run them. On a cluster this is `qsim generate RECIPE -o FOLDER
# --shard 1/2`; with Dask it is `--cluster tcp://HOST:8786`.

for shard in ((1, 2), (2, 2)):
    summary = generate(made, "shared", Options(workers=0, shard=shard))
    print(f"shard {shard[0]} of {shard[1]}: {summary.made} of {summary.jobs} clips made")

# %%
# The shards leave one data set. A repeated call makes nothing again.

print(f"made again: {generate(made, 'shared', Options(workers=0)).made}")
found = qsim.Dataset.open("shared")
print(found)
figure, axes = plt.subplots(2, 3, figsize=(8, 5.6), layout="constrained")
for axis, clip in zip(axes.flat, found.clips("train"), strict=True):
    axis.imshow(clip.radiance(1) ** (1 / 2.2), cmap="gray")
    axis.set_title(clip.name)
    axis.axis("off")
