"""What a real measuring chain costs: accuracy of the live path behind the simulator's amplifier.

    python tests/benchmarks/bench_touch.py [--model NAME|PATH] [--noise bench] [--presses 100] [--rate-Hz 200]
                                           [--warm] [--unplug 20] [--seed 0] [--json]

The model's sensor is pressed with a circle of 1 mm and 1 N at random places of its working area; the frames go through
the whole path, bytes to records, without a port. The device file knows tau to 0.5 % and the gains to 0.2 % (and once
not at all). `--warm` adds the temperature step of 0.5 K in 5 s while touching, for a model of four electrodes, and says
where temperature can be told from force; `--unplug N` pulls a real pseudo-terminal N times.
"""

import argparse
import json
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_predictor import machine

from isocharge.serve import (
    Chunk,
    Frame,
    Port,
    Predictor,
    Script,
    TouchStream,
    VirtualSensor,
    device_from_table,
    encode_frame,
)
from isocharge.simulate import Amplifier, Circle, ForwardMap, Measurement, load_amplifier, sensor_from_dict
from isocharge.train.data.domain import inner_radius

REST_S, PRESS_S, PAUSE_S, RAMP_S = 4.0, 1.5, 1.5, 0.1


def presses(n: int, rate_Hz: float, radius_mm: float, seed: int, force_N: float = 1.0) -> Script:
    """So many presses at random places, straight up and down."""
    rng, period = np.random.default_rng(seed), PRESS_S + PAUSE_S
    t = np.arange(round((REST_S + n * period) * rate_Hz)) / rate_Hz
    number = np.floor((t - REST_S) / period).astype(int).clip(0, n - 1)
    since = np.where(t >= REST_S, (t - REST_S) % period, -1.0)
    rise = np.clip(np.minimum(since, PRESS_S - since) / RAMP_S, 0.0, 1.0)
    place = radius_mm * np.sqrt(rng.uniform(size=n)) * np.exp(2j * np.pi * rng.uniform(size=n))
    force = np.where(rise > 0, np.maximum(force_N * rise, 0.05), 0.0)
    x, y = (np.where(force > 0, part[number], np.nan) for part in (place.real, place.imag))
    return Script(x, y, force, rate_Hz)


def held(seconds: float, rate_Hz: float, at_mm: complex, force_N: float = 1.0) -> Script:
    """One press for so long."""
    t = np.arange(round((REST_S + seconds + 2.0) * rate_Hz)) / rate_Hz
    rise = np.clip(np.minimum(t - REST_S, REST_S + seconds - t) / RAMP_S, 0.0, 1.0)
    force = np.where(rise > 0, np.maximum(force_N * rise, 0.05), 0.0)
    return Script(np.where(force > 0, at_mm.real, np.nan), np.where(force > 0, at_mm.imag, np.nan), force, rate_Hz)


def charges(film: ForwardMap, script: Script) -> np.ndarray:
    """Touch charges (n, electrodes), C."""
    on = script.touching
    charge = np.zeros((len(script), len(film.sensor.electrodes)))
    charge[on] = film.forward(script.x_mm[on] * 1e-3, script.y_mm[on] * 1e-3, script.force_N[on])
    return charge


def board(process: Measurement, electrodes: tuple[str, ...], gain_error: float, seed: int, *, warm: bool) -> Any:
    """The device file of somebody who has calibrated: tau to 0.5 %, gains as given (None: not at all)."""
    rng, n = np.random.default_rng(seed + 1), len(electrodes)
    tau = process.tau * (1 + 0.005 * rng.uniform(-1, 1, n))
    gain = process.gain * (1 + gain_error * rng.uniform(-1, 1, n)) if gain_error else np.ones(n)
    table: dict[str, Any] = {
        "gain": {"pC_per_unit": dict(zip(electrodes, (1 / gain).tolist(), strict=True))},
        "saturation": {"limit_pC": 1499.9},
        "hum": {"frequency_Hz": 50.0},
        "leak": {"tau_s": dict(zip(electrodes, tau.tolist(), strict=True))},
    }
    return device_from_table(table | ({"common_mode": {}} if warm else {}), "bench")


def feel(
    predictor: Predictor,
    charge: np.ndarray,
    rate_Hz: float,
    part: Amplifier,
    gain_error: float,
    seed: int,
    *,
    warm: bool = False,
) -> list[Any]:
    """Records of touch charges (n, electrodes), C, behind an amplifier."""
    electrodes = predictor.metadata.electrodes
    process = part.start(len(electrodes), rate_Hz, np.random.default_rng(seed))
    readings = process(charge) * 1e12
    path, records = TouchStream(predictor, board(process, electrodes, gain_error, seed, warm=warm)), []
    for k, row in enumerate(readings.tolist()):
        frame = Frame(k % 65536, round(1e6 * k / rate_Hz) % 2**32, tuple(row))
        records += path.feed(Chunk(encode_frame(frame), 1e9 + k / rate_Hz, time.perf_counter_ns()))
    return records


def held_presses(predictor: Predictor, part: Amplifier, rate_Hz: float, seed: int) -> dict[str, Any]:
    """400 pC for 8 s and 300 pC for 10 s on every electrode: the worst electrode's error at the end, 8 boards each."""
    t, out = np.arange(round(36.0 * rate_Hz)) / rate_Hz, {}
    presses_of = ((6.0, 8.0, 400.0), (20.0, 10.0, 300.0))
    total = sum(h * np.clip(np.minimum(t - at, at + length - t) / RAMP_S, 0, 1) for at, length, h in presses_of)
    charge = np.repeat(total[:, None], len(predictor.metadata.electrodes), axis=1) * 1e-12
    for tau in (10.0, 1.0):
        for name, rms in (("no thermal drift", 0.0), ("with it", part.temperature_rms)):
            worst = []
            for k in range(8):
                records = feel(predictor, charge, rate_Hz, replace(part, tau=tau, temperature_rms=rms), 0.002, seed + k)
                for at, length, height in presses_of:
                    end = round((at + length - 0.2) * rate_Hz)
                    ends = np.mean([list(r.charge_pC.values()) for r in records[end - 20 : end]], axis=0)
                    worst.append(np.abs(ends - height).max())
                assert not records[-1].contact
            out[f"tau {tau:g} s, {name}, pC"] = percentiles(np.array(worst))
    return out


def accuracy(
    predictor: Predictor, film: ForwardMap, part: Amplifier, n: int, rate_Hz: float, gain_error: float, seed: int
) -> dict[str, Any]:
    """Errors on the plateaus of n presses, delay of the first reading."""
    script = presses(n, rate_Hz, 1e3 * film.radius, seed)
    records = feel(predictor, charges(film, script), rate_Hz, part, gain_error, seed)
    plateau = np.flatnonzero(script.force_N >= 1.0)
    felt = [k for k in plateau if records[k].contact]
    error = np.array([np.hypot(records[k].x_mm - script.x_mm[k], records[k].y_mm - script.y_mm[k]) for k in felt])
    force = np.array([records[k].force_N - 1.0 for k in felt])
    starts = np.flatnonzero(np.diff(script.touching.astype(int)) == 1) + 1
    contact = np.array([record.contact for record in records])
    first = [np.flatnonzero(contact[start : start + round(PRESS_S * rate_Hz)]) for start in starts]
    delay_ms = [1e3 * frames[0] / rate_Hz if frames.size else np.inf for frames in first]
    clipped = np.array(["saturated" in records[k].flags for k in felt])
    away = ~script.touching & ~np.convolve(script.touching, np.ones(round(0.2 * rate_Hz)))[: len(script)].astype(bool)
    return {
        "position_mm": percentiles(error),
        "position_not_saturated_mm": percentiles(error[~clipped]),
        "force_percent": percentiles(100 * np.abs(force)),
        "felt_share": round(len(felt) / len(plateau), 4),
        "saturated_share": round(float(clipped.mean()), 4),
        "first_reading_ms": percentiles(np.array(delay_ms)),
        "false_contact_share": round(float(contact[away].mean()), 5),
    }


def nothing(predictor: Predictor, film: ForwardMap, part: Amplifier, rate_Hz: float, seed: int) -> dict[str, Any]:
    """Ten minutes without a touch."""
    n = round(600 * rate_Hz)
    script = Script(np.full(n, np.nan), np.full(n, np.nan), np.zeros(n), rate_Hz)
    records = feel(predictor, charges(film, script), rate_Hz, part, 0.002, seed)
    return {"false_contacts": sum(record.contact for record in records), "seconds": 600}


def warming(
    predictor: Predictor, film: ForwardMap, part: Amplifier, rate_Hz: float, force_N: float, seed: int
) -> dict[str, Any]:
    """A step of 0.5 K in 5 s in a press of 14 s: how far the force moves, and where warming cannot be told."""
    part, rng, out = replace(part, step=0.5, step_at=REST_S + 3.0), np.random.default_rng(seed), {}
    for radius_mm in (0.5, 2.0, 4.0, 6.0, 7.5):
        moved, blind, flagged, clipped, raw = [], [], [], [], []
        for k in range(6):
            script = held(14.0, rate_Hz, radius_mm * np.exp(2j * np.pi * rng.uniform()), force_N)
            before, after = (round((REST_S + t) * rate_Hz) for t in (2.5, 12.0))
            pressed = charges(film, script)
            records = feel(predictor, pressed, rate_Hz, part, 0.002, seed + k, warm=True)
            plain = feel(predictor, pressed, rate_Hz, part, 0.002, seed + k)
            for kept, made in ((moved, records), (raw, plain)):
                force = [np.mean([r.force_N for r in made[at - 100 : at]]) for at in (before, after)]
                kept.append(100 * abs(force[1] / force[0] - 1))
            clipped.append("saturated" in records[after].flags)
            blind.append("blind" in records[after].flags)
            flagged.append("thermal" in records[after].flags or "blind" in records[after].flags)
        out[f"{radius_mm} mm"] = {
            "force_moves_percent": [round(float(x), 1) for x in moved],
            "without_the_stage_percent": [round(float(x), 1) for x in raw],
            "flagged": sum(flagged),
            "blind": sum(blind),
            "saturated": sum(clipped),
        }
    return out


def unplugging(predictor: Predictor, times: int, seed: int) -> dict[str, Any]:
    """Pull a pseudo-terminal: how long after it is there again the first record and the new tare come."""
    n, back, tared = len(predictor.metadata.electrodes), [], []
    noise = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "film"
        path, stop = TouchStream(predictor), threading.Event()
        plugged: list[float] = []
        worker = threading.Thread(target=plug_and_pull, args=(link, times, n, noise, plugged, stop))
        worker.start()
        while not link.exists():
            time.sleep(0.01)
        with Port(str(link), reconnect=True) as port:
            waiting = False
            for chunk in port:
                for record in path.feed(chunk):
                    if "reconnected" in record.flags:
                        back.append(time.monotonic() - plugged[-1])
                        waiting = True
                    if waiting and record.tare_pC is not None:
                        tared.append(time.monotonic() - plugged[-1])
                        waiting = False
                if len(tared) == times:
                    break
        stop.set()
        worker.join()
    return {
        "outages": path.counts.outages,
        "back_s": percentiles(np.array(back)),
        "tared_s": percentiles(np.array(tared)),
    }


def plug_and_pull(
    link: Path, times: int, electrodes: int, rng: np.random.Generator, plugged: list[float], stop: threading.Event
) -> None:
    """A board at rest that is pulled again and again, for 0.2 to 3 s."""
    script = Script(np.zeros(200), np.zeros(200), np.r_[np.zeros(199), 1e-9], 200.0)
    for _ in range(times + 1):
        plugged.append(time.monotonic())
        with VirtualSensor(lambda contact: np.zeros((len(contact), electrodes)), script, link=link):
            if stop.wait(4.0):
                return
        time.sleep(float(rng.uniform(0.2, 3.0)))


def percentiles(values: np.ndarray) -> dict[str, float]:
    return {f"p{p:g}": round(float(np.percentile(values, p)), 3) for p in (50, 95, 100)} if values.size else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="three-25um-biaxial", help="model name or path")
    parser.add_argument("--noise", default="bench")
    parser.add_argument("--presses", type=int, default=100)
    parser.add_argument("--rate-Hz", type=float, default=200.0)
    parser.add_argument("--warm", action="store_true")
    parser.add_argument("--warm-force", type=float, default=0.5, help="N; uniaxial films saturate `bench` at 1 N")
    parser.add_argument("--unplug", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    asked = parser.parse_args()
    predictor, part = Predictor(asked.model), load_amplifier(asked.noise)
    radius_mm = inner_radius(predictor.metadata.working_area_mm)
    film = ForwardMap.build(sensor_from_dict(dict(predictor.metadata.sensor)), Circle(1e-3), 1e-3 * radius_mm)
    common = (predictor, film, part)
    result = {
        "gains to 0.2 %": accuracy(*common, asked.presses, asked.rate_Hz, 0.002, asked.seed),
        "gains off by 1 % rms": accuracy(*common, asked.presses, asked.rate_Hz, 0.0, asked.seed),
        "nothing": nothing(*common, asked.rate_Hz, asked.seed),
        "held": held_presses(predictor, part, asked.rate_Hz, asked.seed),
    }
    if asked.warm:
        result["warming"] = warming(*common, asked.rate_Hz, asked.warm_force, asked.seed)
    if asked.unplug:
        result["unplugging"] = unplugging(predictor, asked.unplug, asked.seed)
    if asked.json:
        print(json.dumps({"benchmark": "touch", **vars(asked), "machine": machine(), "results": result}))
        return
    print(", ".join(f"{name} {value}" for name, value in machine().items()))
    for name, value in result.items():
        print(name)
        for key, item in value.items():
            print(f"    {key:22s} {item}")


if __name__ == "__main__":
    main()
