"""Trains a network: one loop for all of them, resumable at every step.

    windows (new noise) -> inputs -> model -> loss -> Adam or Muon; at intervals: validation, checkpoint, TensorBoard

Inputs, loss and scored frame are those of the model's system (systems.py). Samples are numbered across steps and
processes: a run that was killed and resumed draws the same ones, and ends with the same weights, as one that was not.
NaN or Inf stop the run; the message names step and samples. Under `torchrun` every process draws its share of a batch.
On a GPU the host reads the numbers of a step two steps later (ahead.py), and before anything is stored.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

from qsim.keys import Key
from qsim.terminal import Tolerant
from quiver import threads
from quiver.data.clips import clips_digest, split_clips, unfinished
from quiver.data.device_light import Unfit
from quiver.data.device_windows import DeviceWindows
from quiver.data.growing import GrowingWindows
from quiver.data.illumination import OTHERS
from quiver.data.rendering import Rendering
from quiver.data.stream_windows import StreamWindows
from quiver.data.windows import Batches, Windows, WindowSettings
from quiver.device import Reading, is_gpu, light_memory, moved, steps_ahead
from quiver.evaluation import metrics
from quiver.host import flushed_denormals
from quiver.model.mosaic_network import MosaicNet
from quiver.model.presets import on_mosaics
from quiver.training.ahead import Copy, Pending
from quiver.training.compiling import Compiled, why_not
from quiver.training.optimiser import Optimiser
from quiver.training.processes import Process, begin_worker, joined, plain_errors
from quiver.training.run_folder import SCHEDULE, Run
from quiver.training.saving import CHECKPOINT_SECONDS, first_line
from quiver.training.schedule import State, learning_rate, note_plateau, share_used, time_is_up, validation_due
from quiver.training.self_supervised import make_stream_windows
from quiver.training.settings import Settings, settled
from quiver.training.system import Batch, Objective, System, collated
from quiver.training.systems import OURS, system_of

AnyWindows = Windows | StreamWindows
FOREVER = 10**9  # steps of a run that only time limits
PREFETCHED = 4  # batches that each worker draws in advance
MOST_WORKERS = 16  # that are started for a GPU if their number is not stated
PLACING = 2  # the same where the GPU draws, and workers state places alone: 0.2 ms for each window
VALIDATION_SIDE = 128  # px, of the validation windows at most


class Diverged(RuntimeError):
    """The loss or a gradient is NaN or Inf: `problem` names the step, the samples and the saved state."""

    def __init__(self, problem: str, cure: str = "lower the learning rate and start again with force=True") -> None:
        super().__init__(f"{problem}; {cure}")
        self.problem = problem


def make_windows(
    settings: Settings,
    multiple: int,
    system: System = OURS,
    frames: int | None = None,
    least: int = 1,
    rendering: Rendering | None = None,
) -> tuple[Windows, Subset[dict[str, Any]]]:
    """Return training and fixed validation windows; without validation clips the training clips, with a warning.

    Sides of validation windows are multiples of `multiple`; they have `frames` frames, by default those of the system.
    `least` frames is the shortest window of the network. While the clips are rendered, windows grow with them.
    """
    window = WindowSettings(
        lights=settings.noise,
        frames=settings.frames,
        crop=settings.crop,
        flips=settings.flips,
        reverse=settings.reverse,
        drift=settings.drift,
        force_exposure=settings.force_exposure,
        still=system.still,
        pool=settings.pool,
        seed=settings.seed,
        least=least,
    )
    windows: Windows
    if rendering is None:
        training, validation = split_clips(settings.data, settings.validation_split)
        windows = Windows(training, window, prepare=system.prepare)
    else:
        if settings.pool is not None:
            raise ValueError(f"pool={settings.pool}: windows of a recipe are of all finished clips; leave it out")
        training, validation = rendering.clips()
        schedule = rendering.schedule(Path(settings.out) / SCHEDULE)
        windows = GrowingWindows(training, window, schedule, prepare=system.prepare)
    for noise in windows.noise.noises:
        if noise.sensing.exposures is not None:
            raise ValueError(f"{noise.sensor}: networks do not know exposures that take turns; {OTHERS}")
    if not validation:
        names = ", ".join(settings.folders)
        split = settings.validation_split
        warnings.warn(f"{names}: no clip in split '{split}'; validating on training clips", stacklevel=2)
        validation = training
    side = min(VALIDATION_SIDE, *(min(clip.shape[1:]) for clip in validation.alike())) // multiple * multiple
    middle = replace(
        window, drift=0, pool=None, frames=frames or system.frames, crop=max(side, multiple), ceiling=math.inf
    )
    fixed = Windows(validation, middle, fixed=True, prepare=system.prepare)
    return windows, Subset(fixed, fixed.spread(settings.validation_windows))


class NumbersWhileRendering(Batches):
    """Sample numbers of batch after batch; clips that are finished when a batch is given out may be drawn by it."""

    def __init__(self, numbers: Batches, rendering: Rendering, windows: GrowingWindows) -> None:
        super().__init__(numbers.batch, numbers.first, numbers.last)
        self.rendering = rendering
        self.schedule = windows.schedule

    def __iter__(self) -> Iterator[list[int]]:
        for numbers in super().__iter__():
            self.rendering.look(self.schedule, numbers[0])
            yield numbers


def on_its_device(windows: AnyWindows, settings: Settings, process: Process) -> tuple[DeviceWindows | None, list[str]]:
    """Return what draws the windows on the device of this process, None where the host does; and a line about it.

    `ValueError` where the device is asked for and cannot.
    """
    wanted = settings.windows == "device" or (settings.windows == "auto" and is_gpu(process.device))
    if not wanted:
        return None, []
    try:
        if isinstance(windows, StreamWindows):
            raise Unfit("they are crops of a stream")
        if isinstance(windows, GrowingWindows):
            raise Unfit("their clips are rendered meanwhile")
        found = DeviceWindows(windows, process.device, light_memory(process.device))
    except Unfit as error:
        if settings.windows == "device":
            raise ValueError(f"windows=device: no device draws these windows: {error}; leave it out") from None
        return None, [f"windows are drawn on the host: {error}"]
    return found, [f"windows are drawn on the device, which holds {found.held.light.nbytes / 1e9:.3g} GB of light"]


def batches(
    windows: AnyWindows,
    settings: Settings,
    state: State,
    process: Process,
    rendering: Rendering | None = None,
    device: DeviceWindows | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield the batches from the current step on; workers, or a device, draw the same ones as this process."""
    last = state.step if state.finished else settings.steps or FOREVER
    numbers = Batches(settings.batch, state.step, last, process.rank, process.world)
    workers = drawing_processes(settings.workers, process, most=MOST_WORKERS if device is None else PLACING)
    if rendering is not None:
        assert isinstance(windows, GrowingWindows)
        numbers = NumbersWhileRendering(numbers, rendering, windows)
    loader: DataLoader[Any] = DataLoader(
        windows if device is None else device.places,
        batch_sampler=numbers,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=PREFETCHED if workers else None,
        collate_fn=collated,
        worker_init_fn=begin_worker,
        generator=torch.Generator(),  # separate: the loader must not change the global random state
        pin_memory=is_gpu(process.device),
    )
    with plain_errors():
        yield from loader if device is None else map(device.draw, loader)


def drawing_processes(asked: int | None, process: Process, most: int) -> int:
    """Return how many processes draw samples: as asked, else none beside a CPU that trains, and most cores for a GPU.

    Each of the processes of a machine that train keeps a core.
    """
    if asked is not None:
        return asked
    if not is_gpu(process.device):
        return 0
    here = int(os.environ.get("LOCAL_WORLD_SIZE", process.world))
    return max(1, min(most, threads.cores() // here - 1))


def parts_of(batch: Batch, count: int) -> Iterator[Batch]:
    """Yield a batch in `count` parts of as many windows each."""
    size = len(batch["codes"]) // count
    for first in range(0, size * count, size):
        yield batch if count == 1 else {name: value[first : first + size] for name, value in batch.items()}


def precision_of(settings: Settings, device: torch.device) -> str:
    """Return float32 or bfloat16: what the settings stand for on a device."""
    automatic = "bfloat16" if is_gpu(device) else "float32"
    return automatic if settings.precision == "auto" else settings.precision


def source_digest(windows: AnyWindows, fixed: Subset[dict[str, Any]] | None) -> str:
    """Return the SHA-256 of the stream that a run learns from, or of its clips to train and to validate on."""
    if isinstance(windows, StreamWindows):
        return windows.codes.digest()
    assert fixed is not None
    assert isinstance(fixed.dataset, Windows)
    return clips_digest(windows.clips, fixed.dataset.clips)


def on_device(batch: Batch, device: torch.device) -> Batch:
    """Return a batch with its tensors on the device; numbers of samples are for messages and stay here."""
    here = {name: value for name, value in batch.items() if not isinstance(value, Tensor) or name == "sample"}
    return here | {name: moved(value, device) for name, value in batch.items() if name not in here}


@torch.no_grad()
def validate(
    model: nn.Module, windows: Subset[dict[str, Any]], device: torch.device, system: System = OURS
) -> tuple[metrics.Score, Tensor]:
    """Return the mean score, and codes, output and target of the first window side by side [h, 3w].

    Windows without a finite PSNR, as black ones restored as black, count only where no window has one.
    """
    model.eval()
    scores: list[metrics.Score] = []
    picture = torch.zeros(1, 1)
    for i in range(len(windows)):
        sample = windows[i]
        restored, first = system.restored(model, system.with_inputs(on_device(collated([sample]), device)))
        output = restored[0].float().cpu().squeeze(1)  # bands of one frame are scored together
        target = sample["target"][first : first + len(output)].squeeze(1)
        if not bool(torch.isfinite(output).all()):
            output = torch.zeros_like(output)  # scored as black; the next training step reports the cause
        unit = float(sample["white"]) / float(sample["peak"])  # scores have one peak for every sensor
        scores.append(metrics.score(output.numpy() * unit, target.numpy() * unit))
        if i == 0:
            shown = [frame.reshape(-1, *frame.shape[-2:]).mean(0) for frame in (output[0], target[0])]
            picture = torch.cat([sample["codes"][first, 0], *shown], dim=1).clamp(0, 1)
    model.train()
    finite = [score for score in scores if math.isfinite(score.psnr_matched)]
    return metrics.mean_score(finite or scores), picture


class Board:
    """Progress bar, and TensorBoard's scalars and pictures."""

    def __init__(self, folder: Path, settings: Settings, state: State, show: bool) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(str(folder), purge_step=state.step or None)
        shown_on = Tolerant(sys.stderr)
        self.bar = tqdm(
            total=settings.steps, initial=state.step, unit="step", disable=not show, mininterval=1, file=shown_on
        )
        self.psnr = ""

    def step(self, number: int, loss: float, norm: float, rate: float) -> None:
        """Show a step; the first one has the number 1."""
        self.bar.update()
        if number % 20 == 0:
            self.bar.set_postfix_str(f"loss {loss:.4f}{self.psnr}", refresh=False)
            for name, value in (("loss", loss), ("gradient norm", norm), ("learning rate", rate)):
                self.writer.add_scalar(f"train/{name}", value, number)

    def validation(self, state: State, score: metrics.Score, picture: Tensor) -> None:
        self.psnr = f", PSNR {score.psnr_matched:.2f} dB"
        for name, value in score.to_dict().items():
            if name != "frames":
                self.writer.add_scalar(f"validation/{name}", value, state.step)
        self.writer.add_image("codes, restored, target", picture[None], state.step)

    def close(self) -> None:
        self.bar.close()
        self.writer.close()


class Trainer:
    """Training of one model: steps, validations when they are due, and checkpoints."""

    def __init__(
        self,
        model: nn.Module,
        run: Run,
        fixed: Subset[dict[str, Any]] | None,
        process: Process,
        system: System,
        note: Callable[[str], None] = lambda line: None,
    ) -> None:
        settings = run.settings
        self.system = system
        self.model = model.to(process.device).train()
        self.run = run
        self.fixed = fixed
        self.process = process
        self.optimiser = Optimiser(model, settings.optimiser, settings.learning_rate, settings.betas)
        self.state = run.load(model, self.optimiser)
        self.objective = Objective(model, system.loss, settings)
        self.parallel: nn.Module | None = None  # the same, joined with other processes; from the first step on
        self.note = note
        self.ahead = steps_ahead(process.device)
        self.pending: deque[Pending] = deque()  # steps whose numbers were not read
        self.copies: list[Copy] = []  # whose memory is free
        self.low = precision_of(settings, process.device) == "bfloat16"
        self.board: Board | None = None
        self.rendering: Rendering | None = None  # of the clips to validate on
        self.started = time.monotonic() - self.state.elapsed
        self.saved = time.monotonic()
        self.loss = math.nan  # of the last step that was read
        self.rate = math.nan
        self.validation = 0.0  # s, duration of the last one
        self.validated = False
        self.stored = run.checkpoint.exists()

    def step(self, batch: dict[str, Any]) -> None:
        """Update the weights by one batch; `Diverged` if its loss or gradient is not finite."""
        settings = self.run.settings
        state = self.state
        device = self.process.device
        if self.process.world > 1:  # the stored random state is the leader's: every process draws from its samples
            torch.manual_seed(Key(settings.seed, int(batch["sample"][0])).philox_key >> 1)
        self.rate = learning_rate(settings, state)
        moved_batch = self.system.with_inputs(on_device(batch, device))
        if self.parallel is None:
            self.parallel = self._ready(moved_batch)
        before = self._copy() if self.ahead else None
        loss = self._gradients(self.parallel, moved_batch)
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip_norm)
        numbers = Reading(torch.stack([loss, norm]))
        samples = batch["sample"].tolist()
        self.pending.append(Pending(replace(state), self.rate, samples, list(batch["key"]), numbers, before))
        if not self.ahead:
            self.settle()  # before the weights change
        self.optimiser.step(self.rate)
        state.step = state.step + 1
        # The learning rate follows the time, so all processes need the same one.
        state.elapsed = self.process.from_leader(time.monotonic() - self.started)
        self.settle(self.ahead)

    def _ready(self, batch: Batch) -> nn.Module:
        """Return the objective as steps compute it: compiled, if the settings say so, and joined with other processes.

        Compiling is tried with the first batch; where it fails in any process, all go on without it.
        """
        if self.run.settings.compile != "off":
            before = Copy().take(self.model, self.optimiser)
            problem = ""
            try:
                network = Compiled(self.model, self.run.settings.compile)
                self.objective.use_compiled(network)
                self._gradients(self.objective, batch, share=1.0)  # of the whole network: a part may learn before it
                problem = "" if network.called else why_not(None)
            except Exception as error:  # of many kinds; what compiling does not cause, the step itself raises again
                problem = why_not(error)
            before.restore(self.model, self.optimiser)
            if self.process.any(problem != ""):
                self.objective.use_compiled(None)
                self.note(problem or "torch.compile fails in another process, so the network is not compiled")
        if self.process.world == 1:
            return self.objective
        # Parameters that a loss does not use at some step (a teacher, a turned-off part)
        # have no gradient; processes wait for all gradients unless told to look.
        return nn.parallel.DistributedDataParallel(self.objective, find_unused_parameters=True)

    def _gradients(self, objective: nn.Module, batch: Batch, share: float | None = None) -> Tensor:
        """Add up the gradients of the parts of a batch, and return its loss, a scalar on the device.

        `share` of the run is over; None: as the state has it.
        """
        settings = self.run.settings
        share = share_used(settings, self.state) if share is None else share
        count = settings.accumulate
        self.model.zero_grad(set_to_none=True)
        total: Tensor | None = None
        for number, part in enumerate(parts_of(batch, count), 1):
            # Processes exchange the gradients of a batch once, after its last part.
            alone = number < count and isinstance(objective, nn.parallel.DistributedDataParallel)
            with objective.no_sync() if alone else contextlib.nullcontext():  # type: ignore[operator]
                with torch.autocast(self.process.device.type, torch.bfloat16, enabled=self.low):
                    loss = objective(part, share)
                loss = loss if count == 1 else loss / count
                loss.backward()
            total = loss.detach() if total is None else total + loss.detach()
        assert total is not None
        return total

    def _copy(self) -> Copy:
        """Return a copy of the state before a step."""
        return (self.copies.pop() if self.copies else Copy()).take(self.model, self.optimiser)

    def settle(self, left: int = 0) -> None:
        """Read the numbers of all steps but the last `left`; `Diverged` for the first one that is not finite."""
        while len(self.pending) > left:
            step = self.pending.popleft()
            self.loss, norm = step.numbers.values()
            if self.process.any(not math.isfinite(self.loss + norm)):
                self._fail(step, norm)
            if self.board is not None:
                self.board.step(step.state.step + 1, self.loss, norm, step.rate)
            if step.before is not None:
                self.copies.append(step.before)

    def _fail(self, step: Pending, norm: float) -> NoReturn:
        """Bring back the state before a bad step, save it and stop, naming the samples."""
        self.pending.clear()
        self.state = step.state
        if step.before is not None:
            step.before.restore(self.model, self.optimiser)
        rank = self.process.rank
        path = self.run.folder / ("failed.pt" if rank == 0 else f"failed-{rank}.pt")
        self.run.save(path, self.model, self.optimiser, self.state, samples=step.samples, keys=step.keys)
        raise Diverged(
            f"step {self.state.step}: loss {self.loss:g}, gradient norm {norm:g}; samples {step.samples} "
            f"({step.keys[0]}; ...); state before the step: {path}"
        )

    def validate_if_due(self) -> None:
        """Determine whether the run ends with this step; validate then, and whenever a validation is due."""
        settings = self.run.settings
        state = self.state
        tenths = state.tenths
        # One process decides for all: clocks differ, and a process that
        # went on alone would wait forever for the others.
        out_of_time = self.process.any(time_is_up(settings, state, self.validation))
        state.finished = state.step == settings.steps or out_of_time
        if not self.process.any(validation_due(settings, state)) and not state.finished:
            return
        self.settle()  # nothing is stored of a step that was not read
        if self.rendering is not None:
            self._await_clips(self.rendering, tenths)
        began = time.monotonic()
        if self.fixed is None:  # nothing to validate on: the last weights count as the best
            if self.board is not None and state.finished:
                self.run.save_weights("best", self.model, state)
        elif self.board is not None:
            score, picture = validate(self.model, self.fixed, self.process.device, self.system)
            self.board.validation(state, score, picture)
            self._record(score)
        state.halvings = int(self.process.from_leader(state.halvings))
        self.validated = True
        self.validation = time.monotonic() - began

    def _await_clips(self, rendering: Rendering, tenths: int) -> None:
        """Wait for all clips to validate on; if that is interrupted, store the run as before this validation."""
        try:
            rendering.complete()
        except KeyboardInterrupt:
            self.state.finished = False
            self.state.tenths = tenths
            self.save(now=True)
            raise

    def _record(self, score: metrics.Score) -> None:
        """Add a validation to the state and its files; keep the weights if they are the best so far."""
        state = self.state
        entry = {"step": state.step, "elapsed": state.elapsed, "loss": self.loss, "learning_rate": self.rate}
        state.history.append(entry | score.to_dict())
        finite = math.isfinite(score.psnr_matched)
        if finite and share_used(self.run.settings, state) >= self.system.begins(self.model, self.run.settings):
            note_plateau(self.run.settings.patience, state, score.psnr_matched)
        if state.best == -math.inf or (finite and score.psnr_matched > state.best):  # without one the newest weights
            state.best = score.psnr_matched if finite else state.best
            self.run.save_weights("best", self.model, state)
        self.run.save_history(state)

    def save(self, *, now: bool) -> None:
        """Write the checkpoint if the last one is old, after the first validation without any, or `now`."""
        first = self.validated and not self.stored
        old = time.monotonic() - self.saved > CHECKPOINT_SECONDS
        if not self.process.any(self.process.leads and (now or first or old)):
            return
        self.settle()
        if self.process.leads:
            self.run.save(self.run.checkpoint, self.model, self.optimiser, self.state)
        self.saved = time.monotonic()
        self.stored = True


def for_bands(model: nn.Module, settings: Settings) -> nn.Module:
    """Return the network with a learned end for the mask of the noise's colour filters; the same without filters.

    `ValueError` for a network with such an end where the noise has no filters.
    """
    filters = settings.lights[0].filters
    if filters is not None:
        return on_mosaics(model, filters.mask)
    if isinstance(model, MosaicNet):
        raise ValueError("start: these weights restore mosaics, and the clips have one band; start from others")
    return model


def train(
    model: nn.Module,
    settings: Settings,
    *,
    device: str = "cpu",
    should_stop: Callable[[], bool] = lambda: False,
    progress: bool = True,
    force: bool = False,
    note: Callable[[str], None] = lambda line: None,
    rendering: Rendering | None = None,
) -> State:
    """Train `model` in place to the end that the settings define, or until `should_stop`; return its state.

    On clips of three bands it becomes the core of a `MosaicNet`, which is what the run stores.
    A run in `settings.out` is resumed; `force` starts it again from the beginning. `note` receives lines about the
    noise of the windows, missing clips, and the step from which the run goes. `rendering` makes the clips meanwhile;
    its first ones are there. ValueError and OSError for settings and
    folders that do not fit, `Diverged` for NaN or Inf. During the call torch has the number of threads that the
    settings ask for, and denormal numbers are zero in this thread.
    """
    with joined(device) as process, contextlib.ExitStack() as stack:
        stack.enter_context(flushed_denormals())  # gradients in the tails of GELU are denormal and slow down a step
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        asked = settings.threads
        system = system_of(model)
        windows: AnyWindows
        fixed: Subset[dict[str, Any]] | None = None
        if system.of_stream:
            system.refuse(model, settings)
            windows = make_stream_windows(settings)
            validated = system.validated(model, settings)
            lines = ["noise: that of the stream"]
            earlier = None if force else threads.recorded(Path(settings.out) / "settings.json")
            settings = replace(settings, threads=threads.use(asked, earlier).number)
        else:
            settings, lines = settled(settings, force=force)
            settings = replace(settings, threads=threads.use(asked, settings.threads).number)
            model = for_bands(model, settings)
            system = system_of(model).on(process.device, settings.windows)
            system.refuse(model, settings)
            validated = system.validated(model, settings)
            windows, fixed = make_windows(
                settings, system.side(model), system, validated, system.window(model), rendering
            )
            lines += [] if rendering is not None else unfinished(settings.folders)
        conditions: dict[str, Any] = {"processes": process.world, "computes_in": precision_of(settings, process.device)}
        held, about = on_its_device(windows, settings, process)
        lines += about
        begun = not force and (Path(settings.out) / "settings.json").is_file()
        conditions["rendered"] = "before" if rendering is None else "meanwhile"
        conditions |= {"clips": source_digest(windows, fixed), "validated_frames": validated}
        run = Run(settings, conditions)
        # Made once for its errors: settings that do not fit must not cost the run that `force` removes.
        Optimiser(model.to(process.device), settings.optimiser, settings.learning_rate, settings.betas)
        if process.leads:
            importlib.import_module("torch.utils.tensorboard")  # this and the line above fail before a run is removed
            stack.enter_context(run.open(force=force))
        process.wait()
        trainer = Trainer(model, run, fixed, process, system, note if process.leads else lambda line: None)
        if process.leads:
            for line in lines:
                note(line)
            state = trainer.state
            note(first_line(state.step, steps=settings.steps, begun=begun, finished=state.finished))
            trainer.board = Board(run.folder, settings, trainer.state, progress)
            stack.callback(trainer.board.close)
        trainer.rendering = rendering
        if trainer.state.step == settings.steps and not trainer.state.finished:  # stopped before its last validation
            trainer.validate_if_due()
            trainer.save(now=True)
        for batch in batches(windows, settings, trainer.state, process, rendering, held):
            trainer.step(batch)
            interrupted = process.any(should_stop())
            trainer.validate_if_due()
            ended = trainer.state.finished or interrupted
            trainer.save(now=ended)
            if ended:
                break
        if process.leads:
            run.save_weights("last", model, trainer.state)
        return trainer.state
