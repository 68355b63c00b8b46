"""States when a training run saves its state, and from which step it goes."""

from __future__ import annotations

CHECKPOINT_SECONDS = 120.0  # between two saved states
WHEN = f"saved at the first validation, then every {CHECKPOINT_SECONDS:g} s, at the end and on Ctrl-C"


def first_line(step: int, *, steps: int | None, begun: bool, finished: bool) -> str:
    """Return a sentence: from which step a run goes, and why a run that was begun starts at 0."""
    of = "" if steps is None else f" of {steps}"
    if finished:
        return f"the run is finished: it ended after step {step}"
    if step:
        return f"resumes after step {step}{of}, the last saved state; the state is {WHEN}"
    if begun:
        return f"starts again at step 0{of}: the earlier run ended before it saved its state; the state is {WHEN}"
    return f"starts at step 0{of}; the state is {WHEN}"
