"""Makes arrays plain: whatever memory an array lies in, what is computed from it is computed from one form of it.

    any array  ->  C order, aligned, this machine's bytes, no subclass

Libraries that work on memory (Dr.Jit, torch, `as_strided`, `view`) read strides and bytes; sums in another order differ
in their last digit. So every public function and every reader that takes an array passes it through `plain` first, and
the answer for an array of MATLAB, a slice or a memory map is that for a plain copy, byte for byte.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray as Array


def plain(values: Any, dtype: Any = None) -> Array:
    """Return an array [...] in C order, aligned and in this machine's byte order; a copy only where it is not so yet.

    `ValueError` for a masked array that hides values: what stands below a mask is no value.
    """
    if np.ma.is_masked(values):
        raise ValueError("an array with masked values; fill them first, as in values.filled(0)")
    array = np.asarray(values, dtype)
    return np.require(array, array.dtype.newbyteorder("="), ("C", "A", "E"))
