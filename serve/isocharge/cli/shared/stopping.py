"""How a command that runs until it is stopped ends well."""

import signal
from collections.abc import Iterator
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
