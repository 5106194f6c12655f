"""Fixtures that send faulty inputs to a reader and check its behaviour.

A reader may accept an input or refuse it by an `IsochargeError`. It may not raise other errors, and its time and memory
are limited. `make attack` sends more than a million inputs, and `make test` one in four hundred of each kind,
but at least 20, or one in eighty if reading is slow.
"""

import random
import resource
import time

import pytest

from isocharge.common.errors import IsochargeError

FAST_SHARE = 0.0025
"""Share of the inputs in `make test`."""

LONGEST_S, MOST_BYTES = 3.0, 200e6
"""Largest processor time of an input, s, and largest increase of the peak memory, bytes.

On a busy machine, the measured processor time may be twice as large as on an idle one.
"""

WAITS = 5
"""Largest elapsed time of an input relative to the largest processor time."""

LONGEST_MESSAGE = 5000
"""Largest number of characters of an error message."""


def pytest_addoption(parser):
    parser.addoption("--all-attacks", action="store_true", help="send every input, not one in four hundred")


def peak_bytes():
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.fixture
def attack(request):
    """Function that sends inputs to a reader, `attack(name, read, inputs, count)`.

    `inputs(rng)` returns one input, and `read(data)` reads it.
    """

    share = 1.0 if request.config.getoption("--all-attacks") else FAST_SHARE

    def send(name, read, inputs, count, longest_s=LONGEST_S):
        rng, before = random.Random(name), None
        for _ in range(max(1, min(20, count // 80), round(count * share))):
            judge(name, read, inputs(rng), longest_s)
            before = before or peak_bytes()  # measured after the first input, when the reader has imported its modules
        assert peak_bytes() - before < MOST_BYTES, name

    return send


def judge(name, read, data, longest_s):
    """Fail if a reader raises a wrong error for an input, or exceeds its limits."""
    for _ in range(2):  # the input is tried again, because another program may have used the core
        began, computed = time.perf_counter(), time.thread_time()
        try:
            read(data)
        except IsochargeError as error:
            if len(str(error)) > LONGEST_MESSAGE:
                pytest.fail(f"{name}: a long message for {data!r:.3000}")
        except Exception as error:
            raise AssertionError(f"{name}: {error!r} for {data!r:.3000}") from error
        computed = time.thread_time() - computed  # processor time, which does not depend on other programs
        if computed < longest_s and time.perf_counter() - began < WAITS * longest_s:
            return
    pytest.fail(f"{name}: more than {longest_s} s for {data!r:.3000}")
