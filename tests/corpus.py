"""Broken files by the thousand: bytes flipped, cut, repeated and shuffled, numbers replaced by what is none."""

import copy
import json
import math
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


HUGE = 10**400
"""More than a float holds."""


def nested(depth: int) -> list:
    """Lists within lists."""
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


# fmt: off
VALUES = [
    None, True, False, 0, -1, 1, 2**31, 2**63, HUGE, 1e308, -1e308, 1e-320, 1e15, math.nan, math.inf, "", "1", "all",
    "nan", "\x00", "\ud800", "é" * 300, "../leaves", "/dev/zero", [], {}, [[]], [None] * 3, [1.0] * 3, [0.0] * 9,
    [math.nan] * 3, [HUGE] * 3, [0] * 16, {"0": 0}, {"": []}, nested(80),
]
# fmt: on
"""What stands where another value did in a JSON file."""


def mutated_json(data: bytes, seed: int) -> bytes:
    """A JSON file that is still one, but broken in one or a few places; the same for the same seed."""
    rng = random.Random(seed)
    content = [json.loads(data)]  # the file itself can be replaced, too
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        content = content or [None]
        holder, key = rng.choice(list(_places(content)))
        rng.choice([_valued, _valued, _scaled, _dropped, _doubled, _swapped])(holder, key, rng)
    return json.dumps(content[0] if content else None).encode()


def _places(node):
    """(container, key) of all that is in a JSON value."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield node, key
        if isinstance(value, dict | list) and value:
            yield from _places(value)


def _valued(holder, key, rng):
    holder[key] = copy.deepcopy(rng.choice(VALUES))


def _scaled(holder, key, rng):
    """Another unit, or the other direction."""
    if type(holder[key]) in (int, float) and abs(holder[key]) < 1e15:
        holder[key] *= rng.choice([1000, 0.001, -1, 1e9])


def _dropped(holder, key, rng):
    del holder[key]


def _doubled(holder, key, rng):
    if isinstance(holder, list):
        holder.insert(key, copy.deepcopy(holder[key]))
    else:
        holder[f"0{key}"] = copy.deepcopy(holder[key])


def _swapped(holder, key, rng):
    other = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]
