"""`isocharge demo`: all of isocharge once, on this machine: simulate, train, serve, show."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from isocharge.cli.demo.live_film import show_live_film
from isocharge.cli.demo.page import Live, draw_page
from isocharge.cli.shared.live_page import LiveOption, page_address
from isocharge.cli.shared.options import ConfigOption
from isocharge.cli.shared.terminal import say, shown_progress, this_command
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.arrays import Array
from isocharge.common.files import new_folder
from isocharge.common.progress import report
from isocharge.serve import BinaryParser, Port, PredictionRecord, Predictor, stream
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.virtual_sensor.pseudo_port import posix_modules
from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, noise_model, press, read_dataset
from isocharge.simulate.dataset.sweep import solve_maps, write_sweep
from isocharge.train import Release, fit, load_config, release

SENSOR, SAMPLES, RATE_HZ, SEED = "three-25um-biaxial", 24_000, 200.0, 0
"""Sensor of the demo, presses that it is trained on, frames per second of its live part, seed of both."""

LIVE_S = 20.0
"""Duration of the live part, s."""

SHOWN_PRESS = ((3.0, -2.0), 1.0)
"""Position (mm) and force (N) of the press whose film is drawn."""

TEST_PRESSES = 4096
"""Presses of another seed on which the errors are measured."""


@dataclass
class Clock:
    """Duration of each step by its name, s."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str, description: str) -> Iterator[None]:
        """Announce a step, show its progress, and time it."""
        say(f"\n{len(self.seconds) + 1}. {name}: {description}")
        began = time.perf_counter()
        with shown_progress():
            yield
        self.seconds[name] = time.perf_counter() - began


def demo_command(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder to make for the results. (default: demo-output; demo-output-2, ... if it exists)",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            min=3.0,
            max=1e6,
            help="Duration of the live part, s. (default: 20; with --live until Ctrl-C)",
        ),
    ] = None,
    config: ConfigOption = None,
    live: LiveOption = None,
) -> None:
    """Show what isocharge does: simulate a film, train a model, follow a virtual sensor live, and draw the results.

    Takes about two minutes. Writes dataset, model and one page of pictures (mm, N, pC) into a new folder. --live only
    follows a virtual sensor on a page for browsers, with the released model; it trains and writes nothing.

    Example: isocharge demo -o first-light
    """
    posix_modules()  # no pseudo-terminal: an error before anything is computed
    if live is not None:
        show_live_film(SENSOR, RATE_HZ, SEED, page_address(live, None), seconds)
        return
    settings = load_config(config) if config else None
    folder, clock, sweep = output or _free_name(Path("demo-output")), Clock(), Sweep(samples=SAMPLES, seed=SEED)
    with new_folder(folder) as draft:
        with clock.step("simulate", f"{SENSOR}, circle of 1 mm, 0.05 to 2 N, within 8 mm"):
            (forward_map,) = solve_maps(load_sensor(SENSOR), (Circle(1.0),), sweep)
            dataset = read_dataset(write_sweep(draft / "presses", (forward_map,), sweep))
            say(
                f"   {len(dataset.samples)} presses interpolated from {forward_map.solves} solves, relative error "
                f"{forward_map.error:.1e}"
            )
        with clock.step("train", "a small network on noisy charges, exported to ONNX"):
            model = release(fit(dataset, settings), draft / "models" / SENSOR, command=this_command())
            say(f"   median position error {model.metadata.errors['position_median_mm']:g} mm with noise")
        with clock.step(
            "serve", f"a virtual sensor sends {RATE_HZ:g} frames/s over a pseudo-terminal, the model answers live"
        ):
            followed = _follow_live(forward_map, Predictor(model.folder), seconds or LIVE_S)
            say(f"   {followed.frames} frames, {followed.lost} lost, {followed.repeated} repeated")
        with clock.step("show", "one page of pictures"):
            pressed, estimated = _test_presses(forward_map, model, sweep)
            equilibrium = press(forward_map.sensor.film, forward_map.probe, *SHOWN_PRESS)
            draw_page(forward_map, equilibrium, followed, pressed, estimated, draft / "demo.png")
            latency_us = _latency_us(Predictor(model.folder), dataset.samples.charge_pC)
    say(f"   {folder / 'demo.png'}")
    typer.echo(_summary(pressed, estimated, followed, model, latency_us, clock, folder))


def _free_name(base: Path) -> Path:
    """`base`, or the first of base-2, base-3, ... that does not exist."""
    if not base.exists():
        return base
    return next(path for path in (base.with_name(f"{base.name}-{k}") for k in count(2)) if not path.exists())


def _follow_live(forward_map: ForwardMap, predictor: Predictor, seconds: float) -> Live:
    """Play a virtual sensor, read its port, and print estimate and truth twice a second."""
    parser, gaps = BinaryParser(), SequenceGaps()
    pressed: list[tuple[float, float, float]] = []
    estimated: list[tuple[Any, Any, Any]] = []
    presses: list[int] = []
    say("   estimated: x mm, y mm, N   true: x mm, y mm, N")
    with virtual_sensor(forward_map, "reference", SEED, RATE_HZ) as sensor, Port(sensor.url) as port:
        total, number_of_press, in_contact = round(seconds * RATE_HZ), 0, False
        for number, record in zip(range(1, total + 1), stream(port, predictor, parser=parser, gaps=gaps), strict=False):
            truth = sensor.truth(int(record.seq or 0))
            both = record.contact and truth.force_N > 0.0
            number_of_press += both and not in_contact
            in_contact = both
            if both:
                pressed.append((truth.x_mm, truth.y_mm, truth.force_N))
                estimated.append((record.x_mm, record.y_mm, record.force_N))
                presses.append(number_of_press)
            if number % round(RATE_HZ / 2) == 0:
                report("following", number, total)
                say(_line(record, truth.x_mm, truth.y_mm, truth.force_N))
    counts = parser.counts.frames, gaps.lost, gaps.repeated
    return Live(np.array(pressed), np.array(estimated), np.array(presses), *counts)


def _line(record: PredictionRecord, x_mm: float, y_mm: float, force_N: float) -> str:
    """The model's contact, and the true one."""

    def columns(in_contact: bool, x: Any, y: Any, force: Any) -> str:
        return f"{x:7.2f} {y:7.2f} {force:6.3f}" if in_contact else f"{'no contact':>22}"

    estimated = columns(record.contact, record.x_mm, record.y_mm, record.force_N)
    return f"   {estimated}     {columns(force_N > 0.0, x_mm, y_mm, force_N)}"


def _test_presses(forward_map: ForwardMap, model: Release, sweep: Sweep) -> tuple[Array, Array]:
    """Presses that training never saw, and the exported model's answers; (x, y, F), both of shape (TEST_PRESSES, 3)."""
    test = Sweep(sweep.radius, sweep.force_range, TEST_PRESSES, sweep.seed + 1)
    contact = test.over((forward_map.probe,)).contact
    charge = noise_model("reference").add(forward_map.charges(contact), np.random.default_rng(test.seed))
    answers = Predictor(model.folder).predict_batch(charge)
    return contact, np.stack(answers[:3], axis=1).astype(float)


def _latency_us(predictor: Predictor, charge: Array, runs: int = 5000) -> tuple[float, float]:
    """Percentiles 50 and 99 of the time of one prediction, us, after a warm-up."""
    durations = []
    for charges in charge[: runs + 500].tolist():
        began = time.perf_counter_ns()
        predictor.predict(charges)
        durations.append(time.perf_counter_ns() - began)
    p50, p99 = np.percentile(durations[500:], (50, 99)) / 1e3
    return float(p50), float(p99)


def _summary(
    pressed: Array,
    estimated: Array,
    live: Live,
    model: Release,
    latency_us: tuple[float, float],
    clock: Clock,
    folder: Path,
) -> str:
    error, live_error = (np.hypot(*(a - b)[:, :2].T) for a, b in ((estimated, pressed), (live.estimated, live.pressed)))
    force_error = 100.0 * (estimated[:, 2] / pressed[:, 2] - 1.0)
    (median, p95), (live_median, live_p95) = np.percentile(error, (50, 95)), np.percentile(live_error, (50, 95))
    size = (folder / "models" / SENSOR / "1" / "model.onnx").stat().st_size
    rows = [
        ("position error, with noise", f"median {median:.3f} mm, 95 % {p95:.3f} mm"),
        ("position error, live", f"median {live_median:.3f} mm, 95 % {live_p95:.3f} mm"),
        (
            "force error",
            f"median {np.median(np.abs(force_error)):.2f} %, rms {np.sqrt(np.mean(force_error**2)):.2f} %",
        ),
        ("model", f"{size / 1024:.0f} KiB, {model.metadata.label}"),
        ("one prediction", f"p50 {latency_us[0]:.1f} us, p99 {latency_us[1]:.1f} us"),
        ("seconds", ", ".join(f"{name} {duration:.1f}" for name, duration in clock.seconds.items())),
        ("results in", str(folder)),
    ]
    return "\n" + "\n".join(f"{name:<32} {value}" for name, value in rows)
