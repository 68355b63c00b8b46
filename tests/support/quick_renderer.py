"""The process that renders while a network trains, with one of the quick renderers of fakes.py: its name, and more."""

import functools
import sys

import fakes

from qsim.dataset import generation
from quiver.data.rendering import main

if __name__ == "__main__":
    generation.generate = functools.partial(generation.generate, make=getattr(fakes, sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
