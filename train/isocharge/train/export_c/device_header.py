"""`isocharge_device.h`: the numbers of a device file, for the signal chain in C."""

from typing import Any

import numpy as np
from msgspec.structs import asdict

from isocharge.common.errors import DeviceError
from isocharge.serve.live.device import Device
from isocharge.serve.signal_chain.hum import LEAST_TURN
from isocharge.train.export_c.c_text import c_comment, c_double, c_doubles, source_text

MOST_TARE_FRAMES = 10_000
"""Frames of a tare that a state in C may hold: 320 kB with four electrodes."""

SWITCHES = {"HUM": "HUM", "TARE": "TARE_ON", "LEAK": "LEAK", "TOUCH": "TOUCH", "THERMAL": "THERMAL_ON"}
"""Prefix of a stage's numbers in C to the name that says whether it runs."""

NAMES = {"frequency_Hz": "HZ"}
"""Settings that C calls otherwise."""


def device_header(device: Device, electrodes: tuple[str, ...]) -> str:
    """The text of `isocharge_device.h`.

    Raises:
        DeviceError: If the device file is for other electrodes, or has a tare that is too long for a state in C.
    """
    chain = device.chain(electrodes)
    if chain.tare is not None and not 1 <= chain.tare.frames <= MOST_TARE_FRAMES:
        raise DeviceError(
            f"{device.where}: tare.frames: expected a whole number from 1 to {MOST_TARE_FRAMES} for a signal chain in "
            f"C, which holds them all, got {chain.tare.frames}"
        )
    numbers = {
        "ZERO": c_doubles(np.zeros(len(electrodes)) if chain.zero is None else chain.zero),
        "GAIN_PC": c_doubles(np.ones(len(electrodes)) if chain.gain_pC is None else chain.gain_pC),
        "LARGEST": c_double(chain.largest),
        "SATURATION": str(int(chain.limit_pC is not None)),
        "HUM_LEAST_TURN": c_double(LEAST_TURN),
    }
    if chain.limit_pC is not None:
        numbers["LIMIT_PC"] = c_double(chain.limit_pC)
    leak = None if chain.tau_s is None else chain.leak
    rules = {"HUM": chain.hum, "TARE": chain.tare, "LEAK": leak, "TOUCH": chain.touch, "THERMAL": chain.thermal}
    for prefix, rule in rules.items():
        settings: dict[str, Any] = {} if rule is None else asdict(rule)
        numbers[SWITCHES[prefix]] = str(int(settings.pop("on", False)))
        if rule is leak and leak is not None:
            settings = {"tau_s": None} | settings | {"tau_s": chain.tau_s}  # first, and one for each electrode
        for name, value in settings.items():
            numbers[f"{prefix}_{NAMES.get(name, name.upper())}"] = _number(value)
    lines = "\n".join(f"#define ISOCHARGE_{name} {text}" for name, text in numbers.items())
    return source_text("isocharge_device.h", board=c_comment(device.name), lines=lines)


def _number(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return c_doubles(value)
    return str(int(value)) if isinstance(value, int) else c_double(value)
