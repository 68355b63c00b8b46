"""Four threads get the answers of a quiet main thread, to the bit, from the public calls that draw and render."""

import subprocess
import sys
from pathlib import Path

import pytest
from compiled_cases import needs_engine

# In a process of its own: without the lock it ended with SIGABRT
PROGRAM = """
import shutil
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import qsim
import qsim.sensor.sensor
import quiver
from qsim.keys import Key
from qsim.sensor import QIS, BinarySPAD, CountingSPAD

place, repeats = Path(sys.argv[1]), int(sys.argv[2])
qsim.sensor.sensor.SMALLEST = 1
EXPOSURE, SHAPE = 5e-4, (3, 24, 36)
light = np.random.default_rng(1).uniform(0, 9, SHAPE).astype(np.float32)
sensors = [QIS(0.8, 1.6, 0.2, 3), QIS(0.8, 1.6, 3.0, 8), BinarySPAD(0.4, 20.0, 3), CountingSPAD(0.5, 100.0, 1e-6, 4)]
budget = qsim.Budget(samples=2, bounces=2)
looks = [{"frames": 2, "height": 12, "width": 16, "budget": budget, "bands": bands} for bands in (None, "rgb")]
if repeats < 10:
    looks.pop()  # colour takes seconds


def drawn(sensor, engine, packed):
    draw = sensor.sample_packed if packed else sensor.sample
    return draw(light, EXPOSURE, key=Key(1, 2, 3), engine=engine)


def on_device(sensor):
    return np.array(sensor.sample_on_device(light, EXPOSURE, key=Key(1, 2, 3)))


def rendered(look, out):
    made = qsim.render("plain", out, **look)
    return np.concatenate([array.ravel() for t in range(2) for array in (made.radiance(t), made.flow(t))])


def sensed(sensor, out):
    own = qsim.Clip.open(shutil.copytree(place / "clip", out))
    return np.asarray(own.sense(sensor, ppp=3.25).codes)


def restored(method, out):
    return quiver.restore(np.minimum(light, 7).astype(np.uint8), method, sensor=sensors[0], exposure=EXPOSURE)


calls = [(drawn, (s, e, p)) for s in sensors for e in ("fast", "reference") for p in (False, True)]
calls += [(on_device, (s,)) for s in sensors]
slow = [(rendered, (look,)) for look in looks] + [(sensed, (s,)) for s in sensors[:2]]
slow += [(restored, (method,)) for method in ("moment", "likelihood", "mergenet")]


qsim.render("plain", place / "clip", **looks[0])


def answers(thread):
    order = np.random.default_rng(thread).permutation(len(calls) * repeats) % len(calls)
    found = {}
    for n in order:
        function, arguments = calls[n]
        found.setdefault(n, []).append(function(*arguments))
    for n, (function, arguments) in enumerate(slow, len(calls)):
        found[n] = [function(*arguments, place / f"out-{thread}-{n}")]
    return found


quiet = answers(0)
barrier = threading.Barrier(4)


def together(thread):
    barrier.wait()
    return answers(thread)


with ThreadPoolExecutor(4) as pool:
    busy = list(pool.map(together, range(1, 5)))
for found in busy:
    for n, arrays in found.items():
        for array in arrays:
            np.testing.assert_array_equal(array, quiet[n][0], strict=True)
print("equal")
"""


@needs_engine
@pytest.mark.parametrize("repeats", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_four_threads_get_the_answers_of_one(tmp_path: Path, repeats):
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path), str(repeats)], capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stdout) == (0, "equal\n"), run.stderr[-2000:]
