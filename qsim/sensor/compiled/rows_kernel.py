"""Draws the codes of a batch in one launch: every row has its own law, light, key, frame and place in the full frame.

    light [B, T, H, W] + a record per row -> one thread per four pixels of a row of pixels -> four codes, a byte each
    the same, packed                      -> one thread per eight pixels -> one byte of eight binary codes

Nothing of a draw is a constant of the kernel: sizes, keys, exposures and tables are arguments. It is compiled once for
each number of bits, type of light and form of codes. A pixel that the cubics of law_table.py leave undecided is decided
by the same thread in float64 with two words, as the reference does. So no pixel goes to the host, and no host waits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from qsim.sensor.compiled.jit import aligned, backend, philox, smaller, uniform32
from qsim.sensor.compiled.law_table import NODES

LIGHT = {"f16": "Float16", "f": "Float", "f64": "Float64"}  # Dr.Jit's types of light
RECORD = 12  # numbers of a record
FOUR = 4  # pixels of a thread, whose codes have a byte each
EIGHT = 8  # pixels of a thread, whose binary codes are packed


class Record(NamedTuple):
    """What a kernel knows of a row, in the order in which it reads it."""

    efficiency: float  # arrivals per unit of light
    dark: float  # arrivals without light
    rate: float  # of its law's table
    margin: float
    first: int  # cell of its law in all tables
    last: int  # cell of its law, counted from its first one
    frame: int  # of its first frame
    planes: int  # summed into a code, each with its own number
    y: int  # of its first pixel in the full frame
    x: int
    key: int  # of 64 bits

    def numbers(self) -> list[float]:
        """Return the RECORD numbers that a kernel reads."""
        *others, key = self
        return [*others, key >> 32, key & 0xFFFFFFFF]


@lru_cache(maxsize=4)  # of two loaders: full batches, and the last one
def places(shape: tuple[int, int, int, int], pixels: int) -> list[Any]:
    """Return the place of each thread of a batch [B, T, H, W] as arguments: an index, how to take it apart, and sizes.

    A thread has FOUR or EIGHT pixels.

    An index holds row, frame, row of pixels and column in the bits of one number. Reading it is cheaper than divisions.
    """
    import drjit as dr

    u32 = backend().UInt32
    rows, frames, height, width = shape
    threads = -(-width // pixels)
    sides = (rows, frames, height, threads)
    below_y = (threads - 1).bit_length()
    below_t = below_y + (height - 1).bit_length()
    below_row = below_t + (frames - 1).bit_length()
    index = aligned(sides, np.uint32)
    index[...] = 0
    for axis, (side, below) in enumerate(zip(sides, (below_row, below_t, below_y, 0), strict=True)):
        numbers = np.arange(side, dtype=np.uint32) << np.uint32(below)
        index |= numbers.reshape([-1 if n == axis else 1 for n in range(4)])
    masks = [(1 << (bits - low)) - 1 for low, bits in ((0, below_y), (below_y, below_t), (below_t, below_row))]
    scalars = (below_y, below_t, below_row, *masks, frames, height, width)
    return [u32(index.reshape(-1)), *(dr.opaque(u32, number) for number in scalars)]


@cache
def kernel(bits: int, light: str, summing: bool, shifted: bool, whole: bool, pixels: int) -> Callable[..., Any]:
    """Return the kernel of codes of so many bits: `places`, light, records, tables -> Int32, four codes each.

    `light` is a name of LIGHT. `summing`: codes of some rows are sums of planes. `shifted`: some rows do not begin at a
    multiple of four columns of the full frame. `pixels`: of a thread, FOUR, or EIGHT whose binary codes are packed into
    UInt8, the first one highest. `whole`: rows have a multiple of them, and the memory of the light begins at a
    multiple of as many numbers.
    """
    import drjit as dr

    return dr.freeze(_Kernel(bits, light, summing, shifted, whole, pixels).draw, warn_after=1000)


@dataclass(frozen=True)
class _Kernel:
    """What is constant in a kernel.

    Each call of a frozen function looks at all globals and variables of outer functions that it names, 14 us for a
    function with everything in it. So the frozen method names none.
    """

    bits: int
    light: str
    summing: bool
    shifted: bool
    whole: bool
    pixels: int

    def draw(self, place: list[Any], given: Any, rows: Any, fast: Any, exact: Any) -> Any:
        """Return the codes of all threads."""
        return self.drawn(place, given, rows, fast, exact)

    def drawn(self, place: list[Any], given: Any, rows: Any, fast: Any, exact: Any) -> Any:
        """Return the same; what a thread computes."""
        import drjit as dr

        jit = backend()
        u32 = jit.UInt32
        index, below_y, below_t, below_row, mask_x, mask_y, mask_t, frames, height, width = place
        row = index >> below_row
        t = (index >> below_t) & mask_t
        line = (index >> below_y) & mask_y
        column = index & mask_x
        law, counts, seed = (dr.gather(jit.Array4f64, rows, row * (RECORD // 4) + n) for n in range(3))
        first, last, frame, planes = (u32(number) for number in counts)
        y, x, high, low = (u32(number) for number in seed)
        at = ((row * frames + t) * height + line) * width + self.pixels * column
        photons = self._photons(given, index, at, self.pixels * column, width)
        cells = [_Cell.of(jit.Float64(value), law, first, last, self.bits) for value in photons]
        middle = [cell.fast(fast, (1 << (self.bits - 1)) - 1) for cell in cells]  # the same for all planes
        words = _Words(x, column * (self.pixels // FOUR), y + line, high, low, self.shifted, self.pixels)
        # Four codes have a byte each, the first one lowest; eight have a bit each, the first one highest.
        shifts = [8 * n for n in range(FOUR)] if self.pixels == FOUR else [7 - n for n in range(EIGHT)]
        frame += t

        def plane(counter: Any) -> Any:
            """Return the codes of one frame, or of one plane of it."""
            now = words.at(counter)
            codes, near = _codes(cells, [uniform32(word) for word in now], middle, fast, _Cell.fast, shifts)

            def decided(_: Any) -> tuple[Any]:
                both = [_uniform64(*pair) for pair in zip(now, words.at(counter, redraw=1), strict=True)]
                begin = [cell.exact(exact, (1 << (self.bits - 1)) - 1) for cell in cells]
                return (_codes(cells, both, begin, exact, _Cell.exact, shifts)[0],)

            open_ = near < jit.Float(law[3])
            return dr.if_stmt((codes,), open_, decided, lambda codes: (codes,), mode="symbolic")[0]

        codes = _summed(plane, frame, planes) if self.summing else plane(frame)
        if self.pixels == FOUR:
            return jit.Int32(codes)
        beyond = dr.maximum(jit.Int32(EIGHT * column + EIGHT) - jit.Int32(width), 0)  # pixels behind the row's end
        return jit.UInt8(codes & (u32(0xFF) << u32(beyond)))

    def _photons(self, given: Any, index: Any, at: Any, column: Any, width: Any) -> list[Any]:
        """Return the light of a thread's pixels, whose first is number `at`; 0 behind the end of a row."""
        import drjit as dr

        jit = backend()
        if self.whole:
            four = getattr(jit, f"Array4{self.light}")
            fours = dr.arange(jit.UInt32, dr.width(index)) * (self.pixels // FOUR)
            return [one for n in range(self.pixels // FOUR) for one in dr.gather(four, given, fours + n)]
        one = getattr(jit, LIGHT[self.light])
        return [dr.gather(one, given, at + n, column + n < width) for n in range(self.pixels)]


def _summed(plane: Callable[[Any], Any], frame: Any, planes: Any) -> Any:
    """Return the sum of the codes of all planes of a frame; each fits its byte, as codes have at most 8 bits."""
    import drjit as dr

    u32 = type(frame)
    _, total = dr.while_loop(
        (u32(0), u32(0)),
        lambda number, _: number < planes,
        lambda number, total: (number + 1, total + plane(frame * planes + number)),
        mode="symbolic",
    )
    return total


def _codes(
    cells: list[_Cell],
    numbers: list[Any],
    middle: list[Any],
    table: Any,
    step: Callable[..., Any],
    shifts: list[int],
) -> tuple[Any, Any]:
    """Return how many steps each uniform number has passed, all in one, and the distance to the nearest step.

    The codes are shifted to their places. `middle` has F of the middle step of each cell, and `step` returns that of
    another one. The steps just before and behind a number are both on the way.
    """
    import drjit as dr

    u32 = backend().UInt32
    joined = u32(0)
    near = type(numbers[0])(1)
    for cell, u, value, shift in zip(cells, numbers, middle, shifts, strict=True):
        code = u32(0)
        half = 1 << (cell.bits - 1)
        while half:
            distance = u - value
            near = smaller(near, dr.abs(distance))
            code += dr.select(distance >= 0, u32(half), u32(0))
            half //= 2
            if half:
                value = step(cell, table, code + (half - 1))
        joined |= code << shift
    return joined, near


def _uniform64(word: Any, further: Any) -> Any:
    """Return the number of two words; the compiled equivalent of `keys.uniform`."""
    double = backend().Float64
    return (double(word) + (double(further) + 0.5) * 2.0**-32) * 2.0**-32


@dataclass(frozen=True)
class _Words:
    """The random words of four or eight neighbours, of which the first need not begin a block."""

    x: Any  # column of the row's first pixel in the full frame
    column: Any  # of the first one, in fours
    y: Any
    high: Any
    low: Any
    shifted: bool
    count: int

    def at(self, counter: Any, redraw: int = 0) -> list[Any]:
        """Return the words of a frame or plane."""
        import drjit as dr

        block = (self.x >> 2) + self.column
        blocks = self.count // FOUR + self.shifted
        found: list[Any] = []
        for n in range(blocks):
            found += philox(block + n, self.y, counter, self.high, self.low, redraw)
        if not self.shifted:
            return found
        for step in (1, 2):
            moved = (self.x & step) != 0
            found = [dr.select(moved, found[n + step], found[n]) for n in range(len(found) - step)]
        return found[: self.count]


@dataclass(frozen=True)
class _Cell:
    """The cell of one pixel in its law's table, and the place in it."""

    bits: int
    place: Any  # of the cell's first step in all tables
    share: Any  # float32, from -1 to 1 in the cell
    cell: Any
    arrivals: Any
    rate: Any

    @classmethod
    def of(cls, light: Any, law: Any, first: Any, last: Any, bits: int) -> _Cell:
        """Return the cell of light; `law` has efficiency, dark, rate and margin of its row."""
        import drjit as dr

        jit = backend()
        arrivals = dr.fma(light, law[0], law[1])
        # A root of float32 and its correction: the root of float64 takes several times as long.
        high = jit.Float(arrivals)
        low = jit.Float(arrivals - jit.Float64(high))
        root = dr.maximum(dr.sqrt(high), 1e-30)
        rate = jit.Float(law[2])
        more = (dr.fma(-root, root, high) + low) * dr.rcp(root) * (0.5 * rate)
        at = root * rate
        # Light beyond the last cell, and what is no number, is in the last one.
        most = jit.Float(last)
        cell = jit.UInt32(dr.select(at < most, at, most))
        share = dr.fma(at - jit.Float(cell) + more, 2, -1)
        return cls(bits, (first + cell) * ((1 << bits) - 1), share, cell, arrivals, law[2])

    def fast(self, table: Any, step: Any) -> Any:
        """Return F of a step in float32."""
        import drjit as dr

        return _polynomial(list(dr.gather(backend().Array4f, table, self.place + step)), self.share)

    def exact(self, table: Any, step: Any) -> Any:
        """Return F of a step in float64."""
        import drjit as dr

        jit = backend()
        share = dr.fma(dr.sqrt(self.arrivals) * self.rate - jit.Float64(self.cell), 2, -1)
        at = (self.place + step) * (NODES // 4)
        return _polynomial([term for n in range(NODES // 4) for term in dr.gather(jit.Array4f64, table, at + n)], share)


def _polynomial(terms: list[Any], x: Any) -> Any:
    """Return the value of a polynomial, of whose coefficients the constant one comes first."""
    import drjit as dr

    *others, value = terms
    for term in reversed(others):
        value = dr.fma(value, x, term)
    return value
