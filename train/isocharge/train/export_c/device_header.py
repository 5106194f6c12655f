"""`isocharge_device.h`: the numbers of a device file, for the signal chain in C."""

from dataclasses import fields
from typing import Any

import numpy as np

from isocharge.common.errors import DeviceError
from isocharge.serve.live.device import Device
from isocharge.serve.signal_chain.chain import Chain
from isocharge.serve.signal_chain.hum import LEAST_TURN
from isocharge.train.export_c.c_text import c_comment, c_double, c_doubles, source_text

MOST_TARE_FRAMES = 10_000
"""Frames of a tare that a state in C may hold: 320 kB with four electrodes."""

RULES = {"hum": "HUM", "tare": "TARE", "leak": "LEAK", "touch": "TOUCH", "thermal": "THERMAL"}
"""Field of a `Chain` to the prefix of its numbers in C."""

SWITCHES = {"hum": "HUM", "tare": "TARE_ON", "leak": "LEAK", "touch": "TOUCH", "thermal": "THERMAL_ON"}
"""Field of a `Chain` to the name that says in C whether the stage runs."""

NAMES = {"frequency_Hz": "HZ"}
"""Settings that C calls otherwise."""


def device_header(device: Device, electrodes: tuple[str, ...]) -> str:
    """The text of `isocharge_device.h`.

    Raises:
        DeviceError: If the device file is for other electrodes, or has a tare that is too long for a state in C.
    """
    chain = device.chain(electrodes)
    _check_tare(device, chain)
    gain_pC = np.ones(len(electrodes)) if chain.gain_pC is None else chain.gain_pC
    zero = np.zeros(len(electrodes)) if chain.zero is None else chain.zero
    numbers = {
        "ZERO": c_doubles(zero),
        "GAIN_PC": c_doubles(gain_pC),
        "LARGEST": c_double(chain.largest),
        "SATURATION": str(int(chain.limit_pC is not None)),
        "HUM_LEAST_TURN": c_double(LEAST_TURN),
    }
    if chain.limit_pC is not None:
        numbers["LIMIT_PC"] = c_double(chain.limit_pC)
    for stage, prefix in RULES.items():
        rule = getattr(chain, stage)
        numbers[SWITCHES[stage]] = str(int(rule is not None))
        numbers |= {} if rule is None else _numbers(prefix, rule)
    lines = "\n".join(f"#define ISOCHARGE_{name} {text}" for name, text in numbers.items())
    return source_text("isocharge_device.h", board=c_comment(device.name), lines=lines)


def _numbers(prefix: str, rule: Any) -> dict[str, str]:
    """The settings of a rule by their names in C."""
    return {
        f"{prefix}_{NAMES.get(item.name, item.name.upper())}": _number(getattr(rule, item.name))
        for item in fields(rule)
    }


def _number(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return c_doubles(value)
    return str(int(value)) if isinstance(value, int) else c_double(value)


def _check_tare(device: Device, chain: Chain) -> None:
    if chain.tare is not None and not 1 <= chain.tare.frames <= MOST_TARE_FRAMES:
        raise DeviceError(
            f"{device.where}: tare.frames: expected a whole number from 1 to {MOST_TARE_FRAMES} for a signal chain in "
            f"C, which holds them all, got {chain.tare.frames}"
        )
