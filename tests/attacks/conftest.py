"""How an attack is counted and judged: by inputs of each reader, and by what none of them may do.

An input may be refused by an error of ours, or be taken. It may raise nothing else, take no second, and cost no memory.
`make attack` sends more than a million; the part in `make test` sends the same kinds, a hundredth of each.
"""

import json
import os
import random
import resource
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import pytest

from isocharge.common.errors import IsochargeError

FAST_SHARE = 0.01
"""Share of the inputs in `make test`."""

LONGEST_S, MOST_BYTES = 1.0, 200e6
"""What no input may take: time, and memory above that before the attack."""

WAITS = 5
"""How much longer an input may take by the clock, with other programs on the same cores."""

LONGEST_MESSAGE = 5000
"""Characters of an error for people."""

COUNTS: Counter[str] = Counter()


def pytest_addoption(parser):
    parser.addoption("--all-attacks", action="store_true", help="send every input, not one in a hundred")


@pytest.fixture
def share(request):
    """Share of the inputs to send."""
    return 1.0 if request.config.getoption("--all-attacks") else FAST_SHARE


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def attack(share):
    """Send inputs to a reader: `attack(name, read, inputs, count)`; inputs(rng) makes one, and read may refuse it."""
    before = resident_bytes()

    def send(name, read, inputs, count, seed=0):
        rng = random.Random(f"{name} {seed}")
        taken = 0
        number = max(20, round(count * share))
        for _ in range(number):
            data = inputs(rng)
            taken += judged(name, read, data)
        COUNTS[name] += number
        assert resident_bytes() - before < MOST_BYTES, name
        return taken

    yield send
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    assert peak - before < 4 * MOST_BYTES  # of the whole test, its own imports among it


def judged(name, read, data):
    """Whether a reader takes an input; what it may not do fails the test, with the input."""
    for _ in range(2):  # another program may have had the core
        began, computed = time.perf_counter(), time.thread_time()
        try:
            read(data)
            is_taken = True
        except IsochargeError as error:
            is_taken, message = False, str(error)
            if len(message) > LONGEST_MESSAGE:
                pytest.fail(f"{name}: a message of {len(message)} characters for {shown(data)}")
        except Exception as error:
            raise AssertionError(f"{name}: {error!r} for {shown(data)}") from error
        computed = time.thread_time() - computed  # its work, whoever else has the core; and its waiting, at most
        if computed < LONGEST_S and time.perf_counter() - began < WAITS * LONGEST_S:
            return is_taken
    raise AssertionError(f"{name}: more than {LONGEST_S} s for {shown(data)}")


def shown(data):
    return repr(data)[:3000]


@pytest.fixture
def counted():
    """Count inputs that a test sends in its own way."""

    @contextmanager
    def count(name, number):
        yield
        COUNTS[name] += number

    return count


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["attacks"] = json.dumps(COUNTS)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    COUNTS.update(json.loads(getattr(node, "workeroutput", {}).get("attacks", "{}")))


def pytest_unconfigure(config):
    if hasattr(config, "workeroutput") or not config.getoption("--all-attacks", False):
        return
    parts = ", ".join(f"{name} {count:,}" for name, count in sorted(COUNTS.items()))
    print(f"\n{COUNTS.total():,} bad inputs: {parts}")


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


JUNK = (None, True, False, 0, -1, 1, 1e308, -1e308, float("inf"), float("nan"), 10**23, 2**63, -(2**64), "", "x", "1_0")


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
    if isinstance(value, list):
        changed = list(value)
        at = rng.randrange(len(changed))
        if rng.random() < 0.1:
            del changed[at]
            return changed
        changed[at] = with_junk(rng, changed[at])
        return changed
    key = rng.choice(sorted(value, key=str))
    if rng.random() < 0.1:
        return {name: item for name, item in value.items() if name != key}
    if rng.random() < 0.1:
        return value | {rng.choice(("", "x" * 300, key + "_", "on")): junk(rng)}
    return value | {key: with_junk(rng, value[key])}


@pytest.fixture
def faults():
    """The makers of faults: in bytes, and in values of JSON."""
    return mutated, with_junk
