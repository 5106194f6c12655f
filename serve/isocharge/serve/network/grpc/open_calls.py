"""The calls that are open: so many and no more, and none waits for its client for ever."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from isocharge.common.errors import TooMany


class OpenCalls:
    """Counts the calls of one event loop.

    A client may open calls and say nothing. So when all places are taken, the call that has waited longest for its
    client gives its place to the new one: whoever has something to ask is answered, however many wait.
    """

    def __init__(self, most: int) -> None:
        """Let so many calls be open at a time."""
        self._most, self._open = most, 0
        self._waiting: dict[asyncio.Timeout, None] = {}  # in the order in which they began to wait

    def __len__(self) -> int:
        """The number of open calls."""
        return self._open

    @contextmanager
    def one_more(self) -> Iterator[None]:
        """A place for a call.

        Raises:
            TooMany: If all places are taken, and none waits for its client.
        """
        if self._open >= self._most and not self._make_room():
            raise TooMany(f"all {self._most} calls are taken; try again later")
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1

    @asynccontextmanager
    async def waiting(self, seconds: float) -> AsyncIterator[None]:
        """Wait for the client inside this context.

        Raises:
            TimeoutError: If it takes longer, or the place is needed.
        """
        async with asyncio.timeout(seconds) as timeout:
            self._waiting[timeout] = None
            try:
                yield
            finally:
                self._waiting.pop(timeout, None)

    def _make_room(self) -> bool:
        """End the call that has waited longest; False if none waits."""
        if not self._waiting:
            return False
        oldest = next(iter(self._waiting))
        del self._waiting[oldest]
        oldest.reschedule(asyncio.get_running_loop().time())
        return True
