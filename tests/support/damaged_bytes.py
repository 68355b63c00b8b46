"""Damages the bytes of files, most of them where a header promises something."""

from __future__ import annotations

import random


def mutate(content: bytes, chance: random.Random) -> bytes:
    """One to four mutations of a file's bytes, most of them near its head, where the promises are."""
    changed = bytearray(content)
    for _ in range(chance.randint(1, 4)):
        reach = len(changed) if chance.random() < 0.4 else min(len(changed), 256)
        place = chance.randrange(reach) if reach else 0
        kind = chance.randrange(6)
        if kind == 0 and changed:
            changed[place] ^= 1 << chance.randrange(8)
        elif kind == 1:
            changed[place : place + 4] = chance.choice([b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff\xff\xff\xff", b"9999"])
        elif kind == 2:
            del changed[place:]
        elif kind == 3:
            changed[place:place] = changed[: chance.randrange(64)]
        elif kind == 4:
            changed[place : place + 8] = chance.randbytes(8)
        else:
            digits = [i for i, byte in enumerate(changed[:512]) if 48 <= byte < 58]
            if digits:  # numbers in text headers
                i = chance.choice(digits)
                changed[i : i + 1] = chance.choice([b"0", b"-1", b"99999999999", b"1e9", b"7"])
    return bytes(changed)
