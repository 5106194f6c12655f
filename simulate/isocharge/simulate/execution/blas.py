"""BLAS on one thread."""

from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController

_THREADS = ThreadpoolController()


def single_threaded_blas() -> AbstractContextManager[object]:
    """For many small matrices: BLAS threads would spin at barriers, many times slower when the other cores are busy."""
    limiter: AbstractContextManager[object] = _THREADS.limit(limits=1, user_api="blas")
    return limiter
