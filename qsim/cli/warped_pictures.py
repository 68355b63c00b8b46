"""Makes clips of warped pictures: `python -m qsim.cli.warped_pictures PICTURES -o out/photos --licence FILE`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from qsim.cli.command import command
from qsim.cli.console import RESUMES, output, run
from qsim.cli.usage import Program
from qsim.files import VERSION
from qsim.formats.warped_pictures import WarpedPictures, make
from qsim.streams.clip import Clip


@command(
    "python -m qsim.cli.warped_pictures photographs -o out/photos --licence photographs/copyright --clips 400",
    after_interrupt=RESUMES,
)
def warp(asked: WarpedPictures) -> int:
    """Write the missing clips, and count those that were there."""
    made = make(asked)
    others = sum(Clip.open(path).info.split != asked.split for path in asked.places.values())
    kept = f"; {others} of these keep another split than {asked.split}" if others else ""
    facts = {"folder": str(asked.output), "made": made, "clips": asked.clips}
    output(facts, f"{asked.output}: {made} clips made, {asked.clips - made} were there{kept}")
    return 0


PROGRAM = Program(
    "warped_pictures",
    "Makes clips of warped pictures.",
    VERSION,
    {
        "make": (
            "qsim.cli.warped_pictures:warp",
            "Make clips of photographs and shapes cut from them that slide, turn and zoom before one another.",
        )
    },
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program, which has one command; return its exit code."""
    return run(PROGRAM, ["make", *(sys.argv[1:] if argv is None else argv)])


if __name__ == "__main__":
    sys.exit(main())
