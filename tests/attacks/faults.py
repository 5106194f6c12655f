"""Makers of bad inputs: faults in bytes, and junk in values of JSON."""

BYTES = (
    b"\0",
    b"\xff",
    b"\n",
    b"\r\n",
    b'"',
    b"[",
    b"{",
    b"-",
    b"e9",
    b"_",
    b".",
    b",",
    b"=",
    b"nan",
    b"true",
    b"\xc3",
)

JUNK = (None, True, False, 0, -1, 1, 1e308, -1e308, float("inf"), float("nan"), 10**23, 2**63, -(2**64), "", "x", "1_0")


def mutated(rng, data):
    """Bytes with a few faults: flipped, dropped, doubled, cut, put elsewhere, or something from another place."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        at = rng.randrange(len(data) + 1)
        how = rng.randrange(7)
        if how == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif how == 1:
            del data[at : at + rng.choice((1, 2, 8, 64))]
        elif how == 2:
            data[at:at] = data[at : at + rng.choice((1, 4, 32))] * rng.choice((1, 2, 16))
        elif how == 3:
            data[at:at] = rng.choice(BYTES)
        elif how == 4:
            del data[at:]
        elif how == 5:
            data[at:at] = rng.randbytes(rng.choice((1, 3, 9)))
        else:
            data[at : at + 4] = rng.choice(BYTES) * rng.choice((1, 1, 1, 40))
    return bytes(data)


def junk(rng, depth=0):
    """Any value of JSON, sometimes deep."""
    how = rng.randrange(8 if depth < 4 else 5)
    if how < 5:
        return rng.choice(JUNK)
    if how == 5:
        return "x" * rng.choice((1, 30, 3000)) if rng.random() < 0.5 else chr(rng.randrange(1, 0xD800))
    if how == 6:
        return [junk(rng, depth + 1) for _ in range(rng.randrange(4))]
    return {str(junk(rng, 9))[:20]: junk(rng, depth + 1) for _ in range(rng.randrange(4))}


def with_junk(rng, value):
    """A copy of a value of JSON with junk in one place of it, or a key more or less."""
    if rng.random() < 0.2 or not isinstance(value, dict | list) or not value:
        return junk(rng)
    changed = dict(value) if isinstance(value, dict) else dict(enumerate(value))
    key, how = rng.choice(sorted(changed, key=str)), rng.random()
    if how < 0.1:
        del changed[key]
    elif how < 0.2:
        changed[rng.choice(("", "x" * 300, f"{key}_", "on"))] = junk(rng)
    else:
        changed[key] = with_junk(rng, changed[key])
    return changed if isinstance(value, dict) else list(changed.values())
