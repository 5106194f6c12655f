"""`isocharge demo`: all of isocharge once, on this machine: simulate, train, serve, show."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.demo.live_film import show_live_film
from isocharge.cli.shared.options import ConfigOption
from isocharge.cli.shared.terminal import progress, say, this_command
from isocharge.cli.shared.virtual_sensor import check_pseudo_terminals, virtual_sensor

if TYPE_CHECKING:
    import numpy as np

    from isocharge.serve import PredictionRecord, Predictor
    from isocharge.simulate import ForwardMap, Sweep
    from isocharge.train import Release

SENSOR, SAMPLES, RATE_HZ = "three-25um-biaxial", 24_000, 200.0
"""Sensor of the demo, presses that it is trained on, and frames per second of its live part, Hz."""

LIVE_S = 20.0
"""Duration of the live part, s."""

SHOWN_PRESS = ((3e-3, -2e-3), 1.0)
"""Position (m) and force (N) of the press whose film is drawn."""

TEST_PRESSES = 4096
"""Presses of another seed on which the errors are measured."""


@dataclass
class Clock:
    """Duration of each step by its name, s."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str, description: str) -> Iterator[None]:
        """Announce a step and time it."""
        say(f"\n{len(self.seconds) + 1}. {name}: {description}")
        began = time.perf_counter()
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
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the training data and of the live presses.")] = 0,
    config: ConfigOption = None,
    live_page: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Only follow a virtual sensor, with the released model, on a page that opens in the browser. "
            "(default: all of it)",
        ),
    ] = False,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="With --live: open the page, or only say its address.")
    ] = True,
) -> None:
    """Show what isocharge does: simulate a film, train a model, follow a virtual sensor live, and draw the results.

    Takes about two minutes. Writes dataset, model and one page of pictures (mm, N, pC) into a new folder. --live takes
    some seconds, and trains and writes nothing.

    Example: isocharge demo -o first-light
    """
    check_pseudo_terminals()
    if live_page:
        show_live_film(SENSOR, RATE_HZ, seed, seconds, browser)
        return
    from isocharge.common.files import new_folder
    from isocharge.serve import Predictor
    from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, solve_maps, write_sweep
    from isocharge.train import load_config, train_model

    settings = load_config(config) if config else None
    folder, clock = output or _free_name(Path("demo-output")), Clock()
    sweep = Sweep(samples=SAMPLES, seed=seed)
    with new_folder(folder) as draft:
        with clock.step("simulate", f"{SENSOR}, circle of 1 mm, 0.05 to 2 N, within 8 mm"):
            with progress("solving the film") as advance:
                forward_map = solve_maps(load_sensor(SENSOR), (Circle(1e-3),), sweep, progress=advance)[0]
            dataset = read_dataset(write_sweep(draft / "presses", (forward_map,), sweep))
            say(
                f"   {len(dataset.samples)} presses interpolated from {forward_map.solves} solves, relative error "
                f"{forward_map.error:.1e}"
            )
        with clock.step("train", "a small network on noisy charges, exported to ONNX"):
            with progress("training") as advance:
                release = train_model(
                    dataset, draft / "models" / SENSOR, settings, command=this_command(), progress=advance
                )
            say(f"   median position error {release.metadata.errors['position_median_mm']:g} mm with noise")
        with clock.step(
            "serve", f"a virtual sensor sends {RATE_HZ:g} frames/s over a pseudo-terminal, the model answers live"
        ):
            live = _follow_live(forward_map, Predictor(release.folder), seconds or LIVE_S, seed)
            say(f"   {live.frames} frames, {live.lost} lost, {live.repeated} repeated")
        with clock.step("show", "one page of pictures"), progress("drawing") as advance:
            error_mm, force_error = _measure_and_draw(forward_map, release, live, sweep, draft / "demo.png")
            advance(1, 2)
            latency_us = _latency(Predictor(release.folder), dataset.samples.charge_pC)
    say(f"   {folder / 'demo.png'}")
    typer.echo(_summary(error_mm, force_error, live, release, latency_us, clock, folder))


def _free_name(base: Path) -> Path:
    """`base`, or the first of base-2, base-3, ... that does not exist."""
    if not base.exists():
        return base
    return next(path for path in (base.with_name(f"{base.name}-{k}") for k in count(2)) if not path.exists())


@dataclass(frozen=True)
class Live:
    """What came over the port; n frames are those in which model and script agree that there is a contact.

    Attributes:
        pressed: True (x_mm, y_mm, force_N), shape (n, 3).
        estimated: The model's (x_mm, y_mm, force_N), shape (n, 3).
        presses: Number of the press, shape (n,).
        frames: Number of frames that arrived.
        lost: Number of frames that did not arrive.
        repeated: Number of frames that arrived twice.
    """

    pressed: "np.ndarray"
    estimated: "np.ndarray"
    presses: "np.ndarray"
    frames: int
    lost: int
    repeated: int

    @property
    def error_mm(self) -> "np.ndarray":
        """Distance between estimated and true position, mm, shape (n,)."""
        from isocharge.train.data.presses import position_error

        return position_error(self.estimated, self.pressed)


def _follow_live(forward_map: "ForwardMap", predictor: "Predictor", seconds: float, seed: int) -> Live:
    """Play a virtual sensor, read its port, and print estimate and truth twice a second."""
    import numpy as np

    from isocharge.serve import BinaryParser, Port, SequenceGaps, stream

    parser, gaps = BinaryParser(), SequenceGaps()
    pressed: list[tuple[float, float, float]] = []
    estimated: list[tuple[Any, Any, Any]] = []
    presses: list[int] = []
    say("   estimated: x mm, y mm, N   true: x mm, y mm, N")
    with (
        virtual_sensor(forward_map, "reference", seed, RATE_HZ) as sensor,
        Port(sensor.url) as port,
        progress("following") as advance,
    ):
        total, press, in_contact = round(seconds * RATE_HZ), 0, False
        for number, record in zip(range(1, total + 1), stream(port, predictor, parser=parser, gaps=gaps), strict=False):
            truth = sensor.truth(int(record.seq or 0))
            both = record.contact and truth.force_N > 0.0
            press += both and not in_contact
            in_contact = both
            if both:
                pressed.append((truth.x_mm, truth.y_mm, truth.force_N))
                estimated.append((record.x_mm, record.y_mm, record.force_N))
                presses.append(press)
            if number % round(RATE_HZ / 2) == 0:
                advance(number, total)
                say(_line(record, truth.x_mm, truth.y_mm, truth.force_N))
    return Live(
        np.array(pressed), np.array(estimated), np.array(presses), parser.counts.frames, gaps.lost, gaps.repeated
    )


def _line(record: "PredictionRecord", x_mm: float, y_mm: float, force_N: float) -> str:
    """The model's contact, and the true one."""

    def columns(in_contact: bool, x: Any, y: Any, force: Any) -> str:
        return f"{x:7.2f} {y:7.2f} {force:6.3f}" if in_contact else f"{'no contact':>22}"

    estimated = columns(record.contact, record.x_mm, record.y_mm, record.force_N)
    return f"   {estimated}     {columns(force_N > 0.0, x_mm, y_mm, force_N)}"


def _measure_and_draw(
    forward_map: "ForwardMap", release: "Release", live: Live, sweep: "Sweep", path: Path
) -> tuple["np.ndarray", "np.ndarray"]:
    """Errors of the exported model on test presses, and the page of pictures.

    Returns:
        Position error, mm, and relative force error, shape (TEST_PRESSES,) each.
    """
    import numpy as np

    from isocharge.cli.demo.page import Page, draw_page
    from isocharge.serve import Predictor
    from isocharge.simulate import Sweep, noise_model, press
    from isocharge.train.data.presses import position_error

    x, y, force, _ = Sweep(sweep.radius, sweep.force_range, TEST_PRESSES, sweep.seed + 1).presses()
    charge = noise_model("reference").add(forward_map.forward(x, y, force), np.random.default_rng(sweep.seed + 1))
    estimated = np.stack(Predictor(release.folder).predict_batch(charge * 1e12)[:3], axis=1).astype(float)
    error_mm = position_error(estimated, np.stack([1e3 * x, 1e3 * y, force], axis=1))
    at, shown_force = SHOWN_PRESS
    equilibrium = press(forward_map.sensor.film, forward_map.probe, at, shown_force)
    draw_page(Page(forward_map, equilibrium, live.pressed, live.estimated, live.presses, force, error_mm), path)
    return error_mm, estimated[:, 2] / force - 1.0


def _latency(predictor: "Predictor", charge_pC: "np.ndarray", runs: int = 5000) -> tuple[float, float]:
    """Percentiles 50 and 99 of the time of one prediction, us, after a warm-up."""
    import numpy as np

    presses = charge_pC[: runs + 500].tolist()
    durations = []
    for charges in presses:
        began = time.perf_counter_ns()
        predictor.predict(charges)
        durations.append(time.perf_counter_ns() - began)
    p50, p99 = np.percentile(durations[500:], (50, 99)) / 1e3
    return float(p50), float(p99)


def _summary(
    error_mm: "np.ndarray",
    force_error: "np.ndarray",
    live: Live,
    release: "Release",
    latency_us: tuple[float, float],
    clock: Clock,
    folder: Path,
) -> str:
    import numpy as np

    median, p95 = np.percentile(error_mm, (50, 95))
    live_median, live_p95 = np.percentile(live.error_mm, (50, 95))
    size = (folder / "models" / SENSOR / "1" / "model.onnx").stat().st_size
    rows = [
        ("position error, with noise", f"median {median:.3f} mm, 95 % {p95:.3f} mm"),
        ("position error, live", f"median {live_median:.3f} mm, 95 % {live_p95:.3f} mm"),
        (
            "force error",
            f"median {100 * np.median(np.abs(force_error)):.2f} %, rms {100 * np.sqrt(np.mean(force_error**2)):.2f} %",
        ),
        ("model", f"{size / 1024:.0f} KiB, {release.metadata.label}"),
        ("one prediction", f"p50 {latency_us[0]:.1f} us, p99 {latency_us[1]:.1f} us"),
        ("seconds", ", ".join(f"{name} {duration:.1f}" for name, duration in clock.seconds.items())),
        ("results in", str(folder)),
    ]
    return "\n" + "\n".join(f"{name:<32} {value}" for name, value in rows)
