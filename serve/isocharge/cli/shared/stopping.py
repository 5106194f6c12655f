"""How a command that runs until it is stopped ends well, and what else signals ask of it."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from isocharge.cli.shared.standard_streams import forget


@contextmanager
def until_stopped() -> Iterator[None]:
    """Leave the block without an error at Ctrl-C, at SIGTERM, and when the reader of stdout goes away."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        forget(1)
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def stop_after(seconds: float | None) -> Iterator[None]:
    """As if Ctrl-C were pressed after some time, also where the command waits for a port; None for never."""
    if seconds is None:
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def on_signal(number: signal.Signals, act: Callable[[], object]) -> Iterator[None]:
    """Act when a signal comes."""
    before = signal.signal(number, lambda *_: act())
    try:
        yield
    finally:
        signal.signal(number, before)


def unless_hung_up(act: Callable[[], object]) -> Callable[[], object]:
    """Act at SIGHUP, but stop as at Ctrl-C where it says that the terminal of this command was closed."""
    terminals = [number for number in (0, 1, 2) if os.isatty(number)]

    def act_or_stop() -> None:
        if not all(map(os.isatty, terminals)):
            raise KeyboardInterrupt
        act()

    return act_or_stop
