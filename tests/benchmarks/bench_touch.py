"""What a real measuring chain costs: accuracy of the live path behind the simulator's amplifier.

    python tests/benchmarks/bench_touch.py [--model NAME|PATH] [--presses 100] [--memory] [--json]

The model's sensor is pressed with a circle of 1 mm and 1 N at random places of its working area; the frames of the
amplifier `bench` go through the whole path, bytes to records, without a port. The device file knows tau to 0.5 % and
the gains to 0.2 % (and once not at all). `--memory` holds presses on a film that creeps, and lays a hand over it, and
says where its warmth can be told from force.
"""

import time
from dataclasses import replace

import numpy as np
from shared import options, percentiles, print_results

from isocharge.serve import Chunk, Frame, Predictor, Script, TouchStream, device_from_table, encode_frame
from isocharge.simulate import Circle, ForwardMap, load_amplifier
from isocharge.simulate.sensor.sensor_file import sensor_from_dict

SHARES = (50, 95, 100)
RATE_HZ, REST_S, PRESS_S, PAUSE_S, RAMP_S = 200.0, 4.0, 1.5, 1.5, 0.1


def script_of(presses, end_s, force_N=1.0):
    """Presses (place x + 1j y, begin, end), straight up and down, mm and s."""
    t = np.arange(round(end_s * RATE_HZ)) / RATE_HZ
    place, rise = np.full(t.size, complex(np.nan, np.nan)), np.zeros(t.size)
    for at, begin, end in presses:
        ramp = np.clip(np.minimum(t - begin, end - t) / RAMP_S, 0.0, 1.0)
        place[ramp > 0], rise = at, rise + ramp
    return Script(place.real, place.imag, np.where(rise > 0, np.maximum(force_N * rise, 0.05), 0.0), RATE_HZ)


def charges(film, script):
    """Touch charges, shape (n, electrodes), pC."""
    charge = np.zeros((len(script), len(film.electrodes)))
    contact = np.column_stack([script.x_mm, script.y_mm, script.force_N])
    charge[script.touching] = film.charges(contact[script.touching])
    return charge


def feel(predictor, charge, part, gain_error, seed, sections=None):
    """Records of touch charges behind an amplifier, with the device file of somebody who has calibrated."""
    names, rng = predictor.metadata.electrodes, np.random.default_rng(seed + 1)
    process = part.start(len(names), RATE_HZ, np.random.default_rng(seed))
    tau = process.tau * (1 + 0.005 * rng.uniform(-1, 1, len(names)))
    gain = process.gain * (1 + gain_error * rng.uniform(-1, 1, len(names))) if gain_error else np.ones(len(names))
    table = {
        "gain": {"pC_per_unit": dict(zip(names, (1 / gain).tolist(), strict=True))},
        "saturation": {"limit_pC": part.limit - 0.1},
        "hum": {"frequency_Hz": 50.0},
        "leak": {"tau_s": dict(zip(names, tau.tolist(), strict=True)), "settle_s": 60.0 if sections else 3.0},
    }
    if np.isinf(tau).any():
        del table["leak"], table["hum"]
    if np.isinf(part.limit):
        del table["saturation"]
    pyro = dict(zip(names, process.pyro.tolist(), strict=True))
    known = {"common_mode": {"pC_per_K": pyro}} if "memory" in (sections or {}) and len(names) > 3 else {}
    path, records = TouchStream(predictor, device_from_table(table | known | (sections or {}), "bench")), []
    for k, row in enumerate(process(charge).tolist()):
        frame = Frame(k % 65536, round(1e6 * k / RATE_HZ) % 2**32, tuple(row))
        records += path.feed(Chunk(encode_frame(frame), 1e9 + k / RATE_HZ, time.perf_counter_ns()))
    return records


def held_presses(predictor, part, seed):
    """400 pC for 8 s and 300 pC for 10 s on every electrode: the worst electrode's error at the end, 8 boards each."""
    t, out = np.arange(round(36.0 * RATE_HZ)) / RATE_HZ, {}
    presses = ((6.0, 8.0, 400.0), (20.0, 10.0, 300.0))
    total = sum(h * np.clip(np.minimum(t - at, at + length - t) / RAMP_S, 0, 1) for at, length, h in presses)
    charge = np.repeat(total[:, None], len(predictor.metadata.electrodes), axis=1)
    for tau in (10.0, 1.0):
        for name, rms in (("no thermal drift", 0.0), ("with it", part.temperature_rms)):
            worst = []
            for k in range(8):
                records = feel(predictor, charge, replace(part, tau=tau, temperature_rms=rms), 0.002, seed + k)
                for at, length, height in presses:
                    end = round((at + length - 0.2) * RATE_HZ)
                    ends = np.mean([list(r.charge_pC.values()) for r in records[end - 20 : end]], axis=0)
                    worst.append(np.abs(ends - height).max())
                assert not records[-1].contact
            out[f"tau {tau:g} s, {name}, pC"] = percentiles(worst, SHARES, 3)
    return out


def accuracy(predictor, film, part, presses, gain_error, seed):
    """Errors on the plateaus of presses, delay of the first reading."""
    rng = np.random.default_rng(seed)
    phase = 2j * np.pi * rng.uniform(size=presses)
    places = film.domain.radius * np.sqrt(rng.uniform(size=presses)) * np.exp(phase)
    begin_s = REST_S + (PRESS_S + PAUSE_S) * np.arange(presses + 1)
    script = script_of(zip(places, begin_s, begin_s + PRESS_S, strict=False), begin_s[-1])
    records = feel(predictor, charges(film, script), part, gain_error, seed)
    plateau = np.flatnonzero(script.force_N >= 1.0)
    felt = [k for k in plateau if records[k].contact]
    error = np.array([np.hypot(records[k].x_mm - script.x_mm[k], records[k].y_mm - script.y_mm[k]) for k in felt])
    contact = np.array([record.contact for record in records])
    starts = np.flatnonzero(np.diff(script.touching.astype(int)) == 1) + 1
    clipped = np.array(["saturated" in records[k].flags for k in felt])
    return {
        "position_mm": percentiles(error, SHARES, 3),
        "position_not_saturated_mm": percentiles(error[~clipped], SHARES, 3),
        "force_percent": percentiles([100 * abs(records[k].force_N - 1.0) for k in felt], SHARES, 3),
        "felt_share": round(len(felt) / len(plateau), 4),
        "saturated_share": round(float(clipped.mean()), 4),
        "first_reading_ms": percentiles([1e3 / RATE_HZ * int(contact[start:].argmax()) for start in starts], SHARES, 3),
    }


def nothing(predictor, film, part, seed):
    """Ten minutes without a touch."""
    charge = np.zeros((round(600 * RATE_HZ), len(film.electrodes)))
    return {"false_contacts": sum(record.contact for record in feel(predictor, charge, part, 0.002, seed))}


KNOWN = {"no memory": None} | {
    f"creep {creep:+.0%}, step {step:+.0%}": {
        "memory": {"creep": 0.08 + 0.08 * creep, "thermoelastic": 0.06 + 0.06 * step}
    }
    for creep, step in ((0.0, 0.0), (0.2, 0.2), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2))
}
"""What a device file says of a film that creeps by 8 % in a decade, with a thermoelastic step of 6 %."""


def memory(predictor, film, level, seed):
    """Presses of 60 s and, after a release, of 10 s: largest errors of the force; and a hand 2 K warmer for 10 s."""
    part = replace(load_amplifier(level), creep=0.08, thermoelastic=0.06, film_time=2.5, limit=3000.0)
    out = {}

    def errors(script, records, begin, end):
        at = range(round((begin + 0.12) * RATE_HZ), round((end - 0.12) * RATE_HZ), 20)
        force = [np.mean([r.force_N or np.nan for r in records[k : k + 20]]) for k in at]
        apart = [np.mean([complex(r.x_mm or np.nan, r.y_mm or np.nan) for r in records[k : k + 20]]) for k in at]
        away = np.abs(np.array(apart) - (script.x_mm + 1j * script.y_mm)[at[0]])
        return {
            "force_percent": round(100 * float(np.max(np.abs(np.array(force) - 1))), 1),
            "mm": round(float(away.max()), 2),
        }

    def false(script, records):
        return sum(record.contact for record, touches in zip(records, script.touching, strict=True) if not touches)

    held = script_of([(2.0 - 1.0j, 30.0, 90.0), (2.0 - 1.0j, 100.0, 110.0)], 118.0)
    for name, sections in KNOWN.items():
        records = feel(predictor, charges(film, held), part, 0.002, seed, sections)
        first, second = errors(held, records, 30.0, 90.0), errors(held, records, 100.0, 110.0)
        out[f"{level}, held, {name}"] = first, second, false(held, records)
    warm = replace(part, step=2.0, step_at=30.0, step_for=10.0, pyro_mismatch=0.2)
    for place in (0.5 + 0.3j, 4.0 - 2.0j):
        for name, press in {
            "no press": (),
            "under it": (33.0, 38.0),
            "it comes": (27.0, 37.0),
            "it goes": (35.0, 47.0),
        }.items():
            script = script_of([(place, *press)] if press else [], 118.0)
            records = feel(predictor, charges(film, script), warm, 0.002, seed, KNOWN["creep +0%, step +0%"])
            blind = sum("blind" in record.flags for record in records)
            found = errors(script, records, *press) if press else {}
            out[f"{level}, hand, {name}, {place} mm"] = found, false(script, records), f"blind {blind}"
    return out


def main():
    asked = options(__doc__, presses=100, memory=False)
    predictor, part = Predictor(asked.model), load_amplifier("bench")
    corners = np.array(predictor.metadata.working_area_mm) @ [1.0, 1j]
    radius_mm = float(np.abs(0.5 * (corners + np.roll(corners, 1))).min())
    film = ForwardMap.build(sensor_from_dict(dict(predictor.metadata.sensor)), Circle(1.0), radius_mm)
    if asked.memory:
        results = [memory(predictor, film, level, asked.seed) for level in ("reference", "bench")]
        print_results("memory", asked, results[0] | results[1])
        return
    result = {
        "gains to 0.2 %": accuracy(predictor, film, part, asked.presses, 0.002, asked.seed),
        "gains off by 1 % rms": accuracy(predictor, film, part, asked.presses, 0.0, asked.seed),
        "nothing for 600 s": nothing(predictor, film, part, asked.seed),
        "held": held_presses(predictor, part, asked.seed),
    }
    print_results("touch", asked, result)


if __name__ == "__main__":
    main()
