"""Short time slices, as Linux itself says what a process has."""

import ctypes
import os
import platform
import struct
import threading

import pytest

from isocharge.serve import VirtualSensor, wander
from isocharge.serve.live import time_slice

RELEASE = tuple(int(part) for part in platform.release().split(".")[:2]) if platform.system() == "Linux" else (0, 0)
GETATTR = {"x86_64": 315, "aarch64": 275, "riscv64": 275}.get(platform.machine())

needs_linux = pytest.mark.skipif(RELEASE < (6, 12) or GETATTR is None, reason="needs Linux 6.12")


def attributes(pid=0):
    """Policy, nice and slice (ns) of a process or the calling thread, by sched_getattr(2)."""
    data = ctypes.create_string_buffer(48)
    assert ctypes.CDLL(None).syscall(GETATTR, pid, data, 48, 0) == 0
    _, policy, _, nice, _, runtime, _, _ = struct.unpack("=IIQiIQQQ", data.raw)
    return policy, nice, runtime


def in_a_thread(work):
    """What a function returns in a thread of its own, whose slices end with it."""
    results = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join()
    return results[0]


@needs_linux
def test_linux_grants_the_slice_and_keeps_the_rest():
    policy, nice, before = attributes()
    asked, after = in_a_thread(lambda: (time_slice.ask_for_short_slices(), attributes()))
    assert asked
    assert after == (policy, nice, time_slice.SLICE_NS)
    assert attributes() == (os.SCHED_OTHER, nice, before)


@needs_linux
def test_a_policy_that_somebody_chose_stays():
    """Who runs a stream with `chrt` wants that."""

    def work():
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        return time_slice.ask_for_short_slices(), attributes()[0]

    assert in_a_thread(work) == (False, os.SCHED_BATCH)


@needs_linux
def test_a_stream_has_short_slices(film, models, start_command):
    with VirtualSensor(film.charge_pC, wander(seed=2)) as sensor:
        process = start_command("serve", "stream", "linear", "--models", models, "--port", sensor.url)
        assert process.stdout.readline()
        assert attributes(process.pid)[2] == time_slice.SLICE_NS


@pytest.mark.parametrize(("name", "value"), [("platform.machine", "pdp11"), ("sys.platform", "win32")])
def test_elsewhere_nothing_is_asked(monkeypatch, name, value):
    module, attribute = name.split(".")
    monkeypatch.setattr(getattr(time_slice, module), attribute, (lambda: value) if attribute == "machine" else value)
    before = attributes() if GETATTR else None
    assert not time_slice.ask_for_short_slices()
    assert (attributes() if GETATTR else None) == before
