"""Restriction of the linear algebra library (BLAS) to one thread."""

from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController

_CONTROLLER = ThreadpoolController()


def single_threaded_blas() -> AbstractContextManager[object]:
    """Return a context manager within which BLAS uses only one thread.

    Operations on many small matrices are faster with one thread. Several threads would often wait for each other in
    busy loops. Such waits are long if other processes use the remaining cores.
    """
    limiter: AbstractContextManager[object] = _CONTROLLER.limit(limits=1, user_api="blas")
    return limiter
