"""Asks the scheduler of Linux for short time slices: who wants little at a time gets it sooner.

A reader works for some tenths of a millisecond whenever a frame comes. With the usual slices of some milliseconds,
another process may finish its own first, or interrupt the reader in the middle of a frame. Since Linux 6.12 every
process may choose its own; elsewhere nothing changes.
"""

import ctypes
import os
import platform
import struct
import sys

SLICE_NS = 500_000
"""Longer than a frame takes, ns: a shorter slice ends in the middle of one, with a longer one others come first."""

CALLS = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
"""Numbers of the system call sched_setattr by machine: the C library of Debian 12 has no function for it."""

ATTRIBUTES = struct.Struct("=IIQiIQQQ")
"""sched_attr of sched_setattr(2): size, policy, flags, nice, priority; runtime, deadline and period, ns."""


def ask_for_short_slices() -> bool:
    """Ask for slices of SLICE_NS for the calling thread and what it starts later.

    Returns:
        Whether they were granted. Nobody asks on another system, or where somebody chose another scheduling policy.
    """
    number = CALLS.get(platform.machine())
    if sys.platform != "linux" or number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = ATTRIBUTES.pack(ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, SLICE_NS, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0)
