"""`isocharge demo`: the whole path once, on this machine: simulate, train, serve, show."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.terminal import progress, say, this_command
from isocharge.cli.shared.virtual_sensor import virtual_sensor

if TYPE_CHECKING:
    import numpy as np

    from isocharge.serve import PredictionRecord, Predictor
    from isocharge.simulate import ForwardMap, Sweep
    from isocharge.train import Release

SENSOR, SAMPLES, RATE_HZ = "three-25um-biaxial", 24_000, 200.0

SHOWN_PRESS = ((3e-3, -2e-3), 1.0)
"""Position (m) and force (N) of the press whose film is drawn."""


@dataclass
class Clock:
    """Seconds of each step."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str, words: str) -> Iterator[None]:
        """Time a step and say what it is."""
        say(f"\n{len(self.seconds) + 1}. {name}: {words}")
        began = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - began


def demo_command(
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder to make. (default: demo-output, or -2, -3, ...)"),
    ] = None,
    seconds: Annotated[float, typer.Option("--seconds", min=3.0, max=3600.0, help="How long to feel live, s.")] = 20.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of samples and presses.")] = 0,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Training configuration, TOML. (default: built in)")
    ] = None,
) -> None:
    """All of it, once, on this machine: simulate, train, feel live, and show pictures.

    Example: isocharge demo -o first-light
    """
    from isocharge.files import new_folder
    from isocharge.serve import Predictor
    from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, solve_maps, write_sweep
    from isocharge.train import load_config, train_model

    settings = load_config(config) if config else None
    folder, clock = output or _free_name(Path("demo-output")), Clock()
    sweep = Sweep(samples=SAMPLES, seed=seed)
    with new_folder(folder) as draft:
        with clock.step("simulate", f"{SENSOR}, circle of 1 mm, 0.05 to 2 N, within 8 mm"):
            with progress("solving the film") as advance:
                film = solve_maps(load_sensor(SENSOR), (Circle(1e-3),), sweep, progress=advance)[0]
            dataset = read_dataset(write_sweep(draft / "presses", (film,), sweep))
            say(f"   {len(dataset.samples)} presses from {film.solves} solves, interpolated to {film.error:.1e}")
        with clock.step("train", "a small network, with noise, to ONNX"):
            with progress("training") as advance:
                release = train_model(
                    dataset, draft / "models" / SENSOR, settings, command=this_command(), progress=advance
                )
            say(f"   median position error {release.metadata.errors['position_median_mm']:g} mm with noise")
        with clock.step("serve", f"a virtual sensor on a pseudo-terminal at {RATE_HZ:g} Hz, felt live"):
            live = _feel(film, Predictor(release.folder), seconds, seed)
            say(f"   {live.frames} frames, {live.lost} lost, {live.repeated} repeated")
        with clock.step("show", "one page of pictures"), progress("drawing") as advance:
            error_mm, force_N = _draw(film, release, live, sweep, draft / "demo.png")
            advance(1, 2)
            latency_us = _latency(Predictor(release.folder), dataset.samples.charge_pC)
    say(f"   {folder / 'demo.png'}")
    typer.echo(_closing_table(error_mm, force_N, live, release, latency_us, clock, folder))


def _free_name(base: Path) -> Path:
    """`base`, or the first of base-2, base-3, ... that is not there yet."""
    if not base.exists():
        return base
    return next(path for path in (base.with_name(f"{base.name}-{k}") for k in count(2)) if not path.exists())


@dataclass(frozen=True)
class Live:
    """What was felt over the port.

    Attributes:
        pressed: (x_mm, y_mm, force_N) of every frame in which model and script agree that something touches, (n, 3).
        felt: The model's contact, (n, 3).
        presses: Number of the press, (n,).
        frames: Frames that arrived.
        lost: Frames that did not.
        repeated: Frames that came twice.
    """

    pressed: "np.ndarray"
    felt: "np.ndarray"
    presses: "np.ndarray"
    frames: int
    lost: int
    repeated: int

    @property
    def error_mm(self) -> "np.ndarray":
        """Distance between felt and pressed, mm, (n,)."""
        from isocharge.train.data.presses import position_error

        return position_error(self.felt, self.pressed)


def _feel(film: "ForwardMap", predictor: "Predictor", seconds: float, seed: int) -> Live:
    """Play, read through the port, tare, infer, and print both sides twice a second."""
    import numpy as np

    from isocharge.serve import BinaryParser, Port, SequenceGaps, stream

    parser, gaps = BinaryParser(), SequenceGaps()
    pressed: list[tuple[float, float, float]] = []
    felt: list[tuple[Any, Any, Any]] = []
    presses: list[int] = []
    say("   felt: x mm, y mm, N        pressed: x mm, y mm, N")
    with (
        virtual_sensor(film, "reference", seed, RATE_HZ) as sensor,
        Port(sensor.url) as port,
        progress("feeling") as bar,
    ):
        total, press, touching = round(seconds * RATE_HZ), 0, False
        for number, record in zip(range(1, total + 1), stream(port, predictor, parser=parser, gaps=gaps), strict=False):
            truth = sensor.truth(int(record.seq or 0))
            both = record.contact and truth.force_N > 0.0
            press += both and not touching
            touching = both
            if both:
                pressed.append((truth.x_mm, truth.y_mm, truth.force_N))
                felt.append((record.x_mm, record.y_mm, record.force_N))
                presses.append(press)
            if number % round(RATE_HZ / 2) == 0:
                bar(number, total)
                say(_line(record, truth.x_mm, truth.y_mm, truth.force_N))
    return Live(np.array(pressed), np.array(felt), np.array(presses), parser.counts.frames, gaps.lost, gaps.repeated)


def _line(record: "PredictionRecord", x_mm: float, y_mm: float, force_N: float) -> str:
    def side(here: bool, x: Any, y: Any, force: Any) -> str:
        return f"{x:7.2f} {y:7.2f} {force:6.3f}" if here else f"{'nothing':>22}"

    felt = side(record.contact, record.x_mm, record.y_mm, record.force_N)
    return f"   {felt}     {side(force_N > 0.0, x_mm, y_mm, force_N)}"


def _draw(
    film: "ForwardMap", release: "Release", live: Live, sweep: "Sweep", path: Path
) -> tuple["np.ndarray", "np.ndarray"]:
    """Test presses of another seed through the exported model, and the page; returns position and force errors."""
    import numpy as np

    from isocharge.cli.demo.page import Page, draw_page
    from isocharge.serve import Predictor
    from isocharge.simulate import Sweep, noise_model, press
    from isocharge.train.data.presses import position_error

    x, y, force, _ = Sweep(sweep.radius, sweep.force_range, 4096, sweep.seed + 1).presses()
    charge = noise_model("reference").add(film.forward(x, y, force), np.random.default_rng(sweep.seed + 1))
    felt = np.stack(Predictor(release.folder).predict_batch(charge * 1e12)[:3], axis=1).astype(float)
    error_mm = position_error(felt, np.stack([1e3 * x, 1e3 * y, force], axis=1))
    at, newtons = SHOWN_PRESS
    shown = press(film.sensor.film, film.probe, at, newtons)
    draw_page(Page(film, shown, live.pressed, live.felt, live.presses, force, error_mm), path)
    return error_mm, felt[:, 2] / force - 1.0


def _latency(predictor: "Predictor", charge_pC: "np.ndarray", runs: int = 5000) -> tuple[float, float]:
    """p50 and p99 of one prediction, us, after a warm-up."""
    import numpy as np

    presses = charge_pC[: runs + 500].tolist()
    taken = []
    for charges in presses:
        began = time.perf_counter_ns()
        predictor.predict(charges)
        taken.append(time.perf_counter_ns() - began)
    p50, p99 = np.percentile(taken[500:], (50, 99)) / 1e3
    return float(p50), float(p99)


def _closing_table(
    error_mm: "np.ndarray",
    force_error: "np.ndarray",
    live: Live,
    release: "Release",
    latency_us: tuple[float, float],
    clock: Clock,
    folder: Path,
) -> str:
    import numpy as np

    median, most = np.percentile(error_mm, (50, 95))
    live_median, live_most = np.percentile(live.error_mm, (50, 95))
    size = (folder / "models" / SENSOR / "1" / "model.onnx").stat().st_size
    rows = [
        ("position error, noise included", f"median {median:.3f} mm, 95 % {most:.3f} mm"),
        ("the same, live through the port", f"median {live_median:.3f} mm, 95 % {live_most:.3f} mm"),
        (
            "force error",
            f"median {100 * np.median(np.abs(force_error)):.2f} %, rms {100 * np.sqrt(np.mean(force_error**2)):.2f} %",
        ),
        ("model", f"{size / 1024:.0f} KiB, {release.metadata.label}"),
        ("one prediction", f"p50 {latency_us[0]:.1f} us, p99 {latency_us[1]:.1f} us"),
        ("seconds", ", ".join(f"{name} {taken:.1f}" for name, taken in clock.seconds.items())),
        ("everything is in", str(folder)),
    ]
    return "\n" + "\n".join(f"{what:<32} {value}" for what, value in rows)
