"""Broken files by the thousand: bytes flipped, cut, repeated and shuffled, numbers replaced by what is none."""

import random
import re

# fmt: off
TOKENS = [
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "1e400", "0", "-1",
    "99999999999999999999", "null", "true", "[]", "{}", "'x'", "1;2", "0x10", "1_000",
    "é", "", "\x00", "\ufeff", " ", "\t", "'", "link_that_is_not",
]
# fmt: on
"""What stands where a number did."""
NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def mutated(data: bytes, seed: int) -> bytes:
    """A broken version of a file; the same for the same seed."""
    rng = random.Random(seed)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        data = rng.choice([_flipped, _inserted, _replaced, _replaced, _cut, _without, _repeated, _shuffled])(data, rng)
    return data


def _place(data, rng):
    return rng.randrange(len(data) + 1)


def _flipped(data, rng):
    at = _place(data, rng)
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]


def _inserted(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.choice(TOKENS).encode() + data[at:]


def _replaced(data, rng):
    numbers = list(NUMBER.finditer(data))
    if not numbers:
        return data
    number = rng.choice(numbers)
    return data[: number.start()] + rng.choice(TOKENS).encode() + data[number.end() :]


def _cut(data, rng):
    return data[: _place(data, rng)]


def _without(data, rng):
    at = _place(data, rng)
    return data[:at] + data[at + rng.randrange(50) :]


def _repeated(data, rng):
    at = _place(data, rng)
    return data[:at] + data[at : at + rng.randrange(200)] + data[at:]


def _shuffled(data, rng):
    lines = data.split(b"\n")
    rng.shuffle(lines)
    return b"\n".join(lines)
