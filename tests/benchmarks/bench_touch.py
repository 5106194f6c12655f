"""Accuracy of the live path behind the simulator's amplifier, which has noise, leak, hum, drift and gain errors.

    python tests/benchmarks/bench_touch.py [--model NAME|PATH] [--presses 100] [--hand]

The sensor of the model is pressed with a circle of 1 mm and a force of 1 N at random positions of its working area. The
frames of the amplifier `bench` pass through the whole path from bytes to records, without a port. The time constants in
the device file have errors of up to 0.5 %, and the gains of up to 0.2 %; in one case the gains are missing.

With `--hand`, a hand that is 2 K warmer than the film comes during a press.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from shared import inner_radius_mm, model_film, options, percentiles, print_results

from isocharge.cli.shared.virtual_sensor import film_charges
from isocharge.common.arrays import Array
from isocharge.serve import Chunk, Frame, Predictor, Script, TouchStream, device_from_table, encode_frame
from isocharge.serve.record.record import PredictionRecord
from isocharge.serve.virtual_sensor.script import VirtualScript
from isocharge.simulate import ForwardMap, load_amplifier
from isocharge.simulate.measuring_chain import Amplifier

PERCENTILES = (50, 95, 100)
RATE_Hz = 200.0
REST_s = 4.0
PRESS_s = 1.5
PAUSE_s = 1.5
RAMP_s = 0.1
GAIN_ERROR = 0.002
"""Largest relative error of the gains in the device file."""

LEAK_ERROR = 0.005
"""Largest relative error of the time constants of the leak in the device file."""

WINDOW = 20
"""Number of frames over which errors are averaged."""


Press = tuple[complex, float, float]
"""Position x + iy of a press of 1 N, mm; the time at which its force begins to rise, and that at which it ends, s."""


def press_film(film: ForwardMap, presses: Sequence[Press], end_s: float) -> tuple[Script, Array]:
    """Return the script of presses that do not overlap, which ends at a given time, s, and its touch charges.

    The charges have the shape (n_frame, n_electrode), pC.
    """
    rows = [(0.0, 0.0, 0.0, 0.0)]
    for position, press_begin_s, press_end_s in presses:
        corners = (press_begin_s, 0.0), (press_begin_s + RAMP_s, 1.0), (press_end_s - RAMP_s, 1.0), (press_end_s, 0.0)
        rows += [(time_s, position.real, position.imag, force_N) for time_s, force_N in corners]
    rows.append((end_s, 0.0, 0.0, 0.0))
    script = VirtualScript(presses=tuple(rows)).script(RATE_Hz)
    charge = np.zeros((len(script.contact), len(film.electrodes)))
    charge[script.touching] = film_charges(film)(script.contact[script.touching])
    return script, charge


def stream_records(
    predictor: Predictor,
    charge: Array,
    amplifier: Amplifier,
    gain_error: float,
    seed: int,
    *,
    has_common_mode: bool = False,
) -> list[PredictionRecord]:
    """Return the records of touch charges behind an amplifier.

    The device file contains the leak and the gains of the amplifier with errors, as after a calibration.

    Args:
        predictor: The model.
        charge: Touch charges, shape (n_frame, n_electrode), pC.
        amplifier: The amplifier.
        gain_error: Largest relative error of the gains in the device file; 0 if the gains are unknown.
        seed: Seed of the amplifier and of the errors.
        has_common_mode: Whether the device file states the pyroelectric charges of the electrodes.
    """
    names = predictor.metadata.electrodes
    rng = np.random.default_rng(seed + 1)
    process = amplifier.start(len(names), RATE_Hz, np.random.default_rng(seed))
    tau_s = process.leak_time * (1.0 + LEAK_ERROR * rng.uniform(-1.0, 1.0, len(names)))
    gain = np.ones(len(names))
    if gain_error:
        gain = process.gain * (1.0 + gain_error * rng.uniform(-1.0, 1.0, len(names)))

    def by_electrode(values: Array) -> dict[str, float]:
        return dict(zip(names, values.tolist(), strict=True))

    table: dict[str, Any] = {"gain": {"pC_per_unit": by_electrode(1.0 / gain)}}
    if np.isfinite(tau_s).all():
        table |= {"leak": {"tau_s": by_electrode(tau_s)}, "hum": {"frequency_Hz": 50.0}}
    if np.isfinite(amplifier.limit):
        table["saturation"] = {"limit_pC": amplifier.limit - 0.1}
    if has_common_mode:
        table["common_mode"] = {"pC_per_K": by_electrode(process.pyro_charge_per_K)}

    stream = TouchStream(predictor, device_from_table(table, "bench"))
    records: list[PredictionRecord] = []
    for number, row in enumerate(process(charge).tolist()):
        t_us = round(1e6 * number / RATE_Hz) % 2**32
        data = encode_frame(Frame(number % 2**16, t_us, tuple(row)))
        records += stream.feed(Chunk(data, 1e9 + number / RATE_Hz, time.perf_counter_ns()))
    return records


def contact_errors(script: Script, records: list[PredictionRecord]) -> Array:
    """Return the errors (x, y, F) in the frames with full force, shape (n, 3), mm and N; NaN without a contact."""
    answers = np.array([(record.x_mm, record.y_mm, record.force_N) for record in records], dtype=float)
    return (answers - script.contact)[script.contact[:, 2] >= 1.0]


def accuracy(
    predictor: Predictor, film: ForwardMap, amplifier: Amplifier, count: int, gain_error: float, seed: int
) -> dict[str, Any]:
    """Measure the errors of contacts at full force, and the delay of the first contact.

    Args:
        predictor: The model.
        film: Forward map of the film.
        amplifier: The amplifier.
        count: Number of presses.
        gain_error: Largest relative error of the gains in the device file; 0 if the gains are unknown.
        seed: Seed of positions and amplifier.
    """
    rng = np.random.default_rng(seed)
    phase = 2j * np.pi * rng.uniform(size=count)
    position = film.domain.radius * np.sqrt(rng.uniform(size=count)) * np.exp(phase)
    *begins_s, end_s = REST_s + (PRESS_s + PAUSE_s) * np.arange(count + 1)
    presses = [(place, begin_s, begin_s + PRESS_s) for place, begin_s in zip(position, begins_s, strict=True)]
    script, charge = press_film(film, presses, end_s)
    records = stream_records(predictor, charge, amplifier, gain_error, seed)

    is_contact = np.array([record.contact for record in records])
    is_saturated = np.array(["saturated" in record.flags for record in records])
    x_error_mm, y_error_mm, _ = contact_errors(script, records).T
    error_mm = np.hypot(x_error_mm, y_error_mm)
    first_frames = np.flatnonzero(np.diff(script.touching.astype(int)) == 1) + 1
    delays_ms = [1e3 / RATE_Hz * int(is_contact[first:].argmax()) for first in first_frames]
    return {
        "position_mm": percentiles(error_mm[~np.isnan(error_mm)], PERCENTILES, 3),
        "saturated_share": round(float(is_saturated[is_contact & (script.contact[:, 2] >= 1.0)].mean()), 4),
        "first_reading_ms": percentiles(delays_ms, PERCENTILES, 3),
    }


def warm_hand(predictor: Predictor, film: ForwardMap, seed: int) -> dict[str, Any]:
    """Measure the largest errors of presses during which a hand comes over the film, with and without the estimate.

    The hand comes 3 s after the press begins. The errors are those of means over 20 frames.

    Args:
        predictor: The model.
        film: Forward map of the film.
        seed: Seed of the amplifier.
    """
    results: dict[str, Any] = {}
    hand = {"step": 2.0, "step_at": 10.0, "step_for": 10.0, "pyro_mismatch": 0.2, "limit": 3000.0}
    for level, position, has_common_mode in product(("reference", "bench"), (0.5 + 0.3j, 4.0 - 2.0j), (False, True)):
        amplifier = replace(load_amplifier(level), **hand)
        script, charge = press_film(film, [(position, 7.0, 17.0)], 20.0)
        records = stream_records(predictor, charge, amplifier, GAIN_ERROR, seed, has_common_mode=has_common_mode)
        errors = contact_errors(script, records)
        windows = np.array([part.mean(axis=0) for part in np.array_split(errors, len(errors) // WINDOW)])
        section = "[common_mode]" if has_common_mode else "no section"
        results[f"{level}, {position} mm, {section}"] = {
            "force_percent": round(100.0 * float(np.abs(windows[:, 2]).max()), 1),
            "mm": round(float(np.hypot(windows[:, 0], windows[:, 1]).max()), 2),
        }
    return results


def main() -> None:
    asked = options(__doc__, presses=100, hand=False)
    predictor = Predictor(asked.model)
    amplifier = load_amplifier("bench")
    film = model_film(predictor, inner_radius_mm(predictor))
    if asked.hand:
        print_results("hand", asked, warm_hand(predictor, film, asked.seed))
        return
    rest_charge = np.zeros((round(600 * RATE_Hz), len(film.electrodes)))
    records_at_rest = stream_records(predictor, rest_charge, amplifier, GAIN_ERROR, asked.seed)
    results = {
        "gains to 0.2 %": accuracy(predictor, film, amplifier, asked.presses, GAIN_ERROR, asked.seed),
        "gains off by 1 % rms": accuracy(predictor, film, amplifier, asked.presses, 0.0, asked.seed),
        "false contacts in 600 s": sum(record.contact for record in records_at_rest),
    }
    print_results("touch", asked, results)


if __name__ == "__main__":
    main()
