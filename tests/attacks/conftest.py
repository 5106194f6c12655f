"""How a reader is attacked and judged.

An input may be refused by an error of ours, or be taken. It may raise nothing else, take no seconds and no memory.
`make attack` sends more than a million; the part in `make test` sends the same kinds, a hundredth of each.
"""

import random
import resource
import time

import pytest

from isocharge.common.errors import IsochargeError

FAST_SHARE = 0.01
"""Share of the inputs in `make test`."""

LONGEST_S, MOST_BYTES = 3.0, 200e6
"""What no input may take: processor time, s, of which a busy machine counts up to twice as much, and how much it may
raise the peak of memory, bytes."""

WAITS = 5
"""How much longer an input may take by the clock, with other programs on the same cores."""

LONGEST_MESSAGE = 5000
"""Characters of an error for people."""


def pytest_addoption(parser):
    parser.addoption("--all-attacks", action="store_true", help="send every input, not one in a hundred")


@pytest.fixture
def share(request):
    """Share of the inputs to send."""
    return 1.0 if request.config.getoption("--all-attacks") else FAST_SHARE


def peak_bytes():
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.fixture
def attack(share):
    """Send inputs to a reader: `attack(name, read, inputs, count)`; inputs(rng) makes one, and read may refuse it."""

    def send(name, read, inputs, count, longest_s=LONGEST_S):
        rng, before = random.Random(name), None
        for _ in range(max(20, round(count * share))):
            judge(name, read, inputs(rng), longest_s)
            before = before or peak_bytes()  # once the reader has imported what it needs
        assert peak_bytes() - before < MOST_BYTES, name

    return send


def judge(name, read, data, longest_s):
    """Fail if a reader does with an input what it may not do."""
    for _ in range(2):  # another program may have had the core
        began, computed = time.perf_counter(), time.thread_time()
        try:
            read(data)
        except IsochargeError as error:
            if len(str(error)) > LONGEST_MESSAGE:
                pytest.fail(f"{name}: a long message for {data!r:.3000}")
        except Exception as error:
            raise AssertionError(f"{name}: {error!r} for {data!r:.3000}") from error
        computed = time.thread_time() - computed  # its work, whoever else has the core; and its waiting, at most
        if computed < longest_s and time.perf_counter() - began < WAITS * longest_s:
            return
    pytest.fail(f"{name}: more than {longest_s} s for {data!r:.3000}")
