"""`isocharge demo`: all of isocharge once: simulate, train, serve, show; or a virtual film on the live page."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from itertools import chain, count, islice
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer
from scipy.stats import binned_statistic

from isocharge.cli.shared.live_page import LiveOption, PageFeed, answering, live_page, page_address
from isocharge.cli.shared.options import ConfigOption
from isocharge.cli.shared.terminal import say, shown_progress, this_command, until_stopped
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.arrays import Array
from isocharge.common.files import new_folder
from isocharge.common.progress import track
from isocharge.serve import Port, Predictor, TouchStream, find_model, load_model
from isocharge.serve.benchmark import in_process_contenders, press_charges, take_turns
from isocharge.serve.live.recorded_stream import RecordedStream
from isocharge.serve.live.stream import StreamTotals
from isocharge.serve.network.address import Address
from isocharge.serve.virtual_sensor.sensor import posix_modules
from isocharge.simulate import Circle, Equilibrium, ForwardMap, Sweep, load_sensor, noise_model, press, read_dataset
from isocharge.simulate.dataset.sweep import solve_maps, write_sweep
from isocharge.simulate.plots.figure import FELT, PRESSED, new_figure, save_picture
from isocharge.simulate.plots.film import (
    draw_charge_map,
    draw_deflection,
    draw_electrodes,
    draw_layout,
    draw_section,
)
from isocharge.train import fit, load_config, release

SENSOR, SAMPLES, RATE_HZ, SEED = "three-25um-biaxial", 24_000, 200.0, 0
"""Sensor of the demo, presses that it is trained on, frames per second of its live part, seed of both."""

LIVE_S = 20.0
"""Duration of the live part, s."""

SHOWN_PRESS = ((3.0, -2.0), 1.0)
"""Position (mm) and force (N) of the press whose film is drawn."""

TEST_PRESSES = 4096
"""Presses of another seed on which the errors are measured."""

LATENCY_S = 0.5
"""Time to measure that of a prediction, s."""


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
    folder, sweep = output or _free_name(Path("demo-output")), Sweep(samples=SAMPLES, seed=SEED)
    durations_s: dict[str, float] = {}
    with new_folder(folder) as draft:
        with _step("simulate", f"{SENSOR}, circle of 1 mm, 0.05 to 2 N, within 8 mm", durations_s):
            (forward_map,) = solve_maps(load_sensor(SENSOR), (Circle(1.0),), sweep)
            dataset = read_dataset(write_sweep(draft / "presses", (forward_map,), sweep))
            say(
                f"   {len(dataset.samples)} presses interpolated from {forward_map.solves} solves, relative error "
                f"{forward_map.error:.1e}"
            )
        with _step("train", "a small network on noisy charges, exported to ONNX", durations_s):
            model = release(fit(dataset, settings), draft / "models" / SENSOR, command=this_command())
            predictor = Predictor(model.folder)
            say(f"   median position error {model.metadata.errors['position_median_mm']:g} mm with noise")
        with _step(
            "serve",
            f"a virtual sensor sends {RATE_HZ:g} frames/s over a pseudo-terminal, the model answers live",
            durations_s,
        ):
            followed, totals = _follow_live(forward_map, predictor, seconds or LIVE_S)
            say(f"   {totals.frames} frames, {totals.lost} lost, {totals.repeated} repeated")
        with _step("show", "one page of pictures", durations_s):
            tested = _test_presses(forward_map, predictor, sweep)
            equilibrium = press(forward_map.sensor.film, forward_map.probe, *SHOWN_PRESS)
            draw_page(forward_map, equilibrium, followed, tested, draft / "demo.png")
    say(f"   {folder / 'demo.png'}")
    typer.echo(_summary(tested, followed, durations_s, folder))


@contextmanager
def _step(name: str, description: str, durations_s: dict[str, float]) -> Iterator[None]:
    """Announce a step, show its progress, and note its duration, s."""
    say(f"\n{len(durations_s) + 1}. {name}: {description}")
    began = time.perf_counter()
    with shown_progress():
        yield
    durations_s[name] = time.perf_counter() - began


def _free_name(base: Path) -> Path:
    """`base`, or the first of base-2, base-3, ... that does not exist."""
    further = (base.with_name(f"{base.name}-{k}") for k in count(2))
    return next(path for path in chain([base], further) if not path.exists())


def _follow_live(forward_map: ForwardMap, predictor: Predictor, seconds: float) -> tuple[Array, StreamTotals]:
    """Play a virtual sensor, read its port, and print estimate and truth twice a second.

    Returns:
        Number of the press, true and estimated (x, y, F), mm and N, of the frames in which the model feels a press that
        is there, shape (n, 7); and the counts of the stream.
    """
    touch, total = TouchStream(predictor), round(seconds * RATE_HZ)
    followed: list[tuple[float, ...]] = []
    say("   estimated: x mm, y mm, N   true: x mm, y mm, N")
    with virtual_sensor(forward_map, "reference", SEED, RATE_HZ) as sensor, Port(sensor.url) as port:
        records = islice((record for chunk in port for record in touch.feed(chunk)), total)
        number_of_press, is_felt = 0, False
        for number, record in enumerate(track(records, "following", total), start=1):
            truth = sensor.truth(record.seq or 0)
            pressed = truth.x_mm, truth.y_mm, truth.force_N
            felt = tuple(value or 0.0 for value in (record.x_mm, record.y_mm, record.force_N))
            was_felt, is_felt = is_felt, record.contact and truth.force_N > 0.0
            number_of_press += is_felt and not was_felt
            if is_felt:
                followed.append((number_of_press, *pressed, *felt))
            if number % round(RATE_HZ / 2) == 0:
                say(f"   {_columns(record.contact, felt)}     {_columns(truth.force_N > 0.0, pressed)}")
    return np.array(followed), touch.totals()


def _columns(is_contact: bool, contact: tuple[float, ...]) -> str:
    x, y, force = contact
    return f"{x:7.2f} {y:7.2f} {force:6.3f}" if is_contact else f"{'no contact':>22}"


def _test_presses(forward_map: ForwardMap, predictor: Predictor, sweep: Sweep) -> Array:
    """Presses that training never saw, and the model's answers: (x, y, F) twice, shape (TEST_PRESSES, 6), mm and N."""
    test = Sweep(sweep.radius, sweep.force_range, TEST_PRESSES, sweep.seed + 1)
    contact = test.over((forward_map.probe,)).contact
    charge = noise_model("reference").add(forward_map.charges(contact), np.random.default_rng(test.seed))
    return np.column_stack([contact, *predictor.predict_batch(charge)[:3]])


def _summary(tested: Array, followed: Array, durations_s: dict[str, float], folder: Path) -> str:
    """The table of results; `tested` and `followed` end with the columns of true and estimated presses."""

    def position(presses: Array) -> str:
        error = np.hypot(*(presses[:, -3:-1] - presses[:, -6:-4]).T)
        return "median {:.3f} mm, 95 % {:.3f} mm".format(*np.percentile(error, (50, 95)))

    force_error = 100.0 * (tested[:, 5] / tested[:, 2] - 1.0)
    model = load_model(find_model(str(folder / "models" / SENSOR)))
    predictor = Predictor(model.folder)
    charges = press_charges(predictor, model.golden.charge_pC)
    (latency,) = take_turns(in_process_contenders(predictor, charges)[1:2], LATENCY_S)
    rows = [
        ("position error, with noise", position(tested)),
        ("position error, live", position(followed)),
        (
            "force error",
            f"median {np.median(np.abs(force_error)):.2f} %, rms {np.sqrt(np.mean(force_error**2)):.2f} %",
        ),
        ("model", f"{(model.folder / 'model.onnx').stat().st_size / 1024:.0f} KiB, {model.metadata.label}"),
        ("one prediction", f"p50 {latency.p50_us:.1f} us, p99 {latency.p99_us:.1f} us"),
        ("seconds", ", ".join(f"{name} {duration:.1f}" for name, duration in durations_s.items())),
        ("results in", str(folder)),
    ]
    return "\n" + "\n".join(f"{name:<32} {value}" for name, value in rows)


def show_live_film(sensor: str, rate_Hz: float, seed: int, address: Address, seconds: float | None) -> None:
    """Play a virtual sensor, follow it with the released model, and show both on the live page.

    Args:
        sensor: Name of the sensor and of its model.
        rate_Hz: Frames per second.
        seed: Of the presses.
        address: Where the page listens.
        seconds: Time after which to stop; None for Ctrl-C.
    """
    predictor = Predictor(sensor)
    with shown_progress():
        forward_map = ForwardMap.build(load_sensor(sensor), Circle(1.0))
    touch = TouchStream(predictor)
    live = RecordedStream(touch)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        link = stack.enter_context(live_page(address, None, sensor, predictor.metadata, find_model(sensor)))
        board = stack.enter_context(virtual_sensor(forward_map, "reference", seed, rate_Hz))
        port = stack.enter_context(Port(board.url))
        stack.enter_context(answering(link, live, ("every", {}, "")))
        say("Ctrl-C stops")
        feed = PageFeed(link, touch, live)
        for record, _ in stack.enter_context(closing(live.follow(port))):
            feed.put(record)
            if seconds is not None and touch.counts.records > seconds * rate_Hz:
                break


def draw_page(forward_map: ForwardMap, equilibrium: Equilibrium, followed: Array, tested: Array, path: Path) -> None:
    """Draw the page and write it.

    Args:
        forward_map: The film.
        equilibrium: The press that is shown.
        followed: Live presses: number, true and estimated (x, y, F), shape (n, 7), mm and N.
        tested: Test presses, true and estimated, shape (m, 6).
        path: The picture.
    """
    count = len(forward_map.electrodes)
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))
    left, middle, right = top.subplots(1, 3)
    draw_deflection(left, equilibrium)
    draw_electrodes(left, forward_map.sensor, names=False)
    draw_section(middle, equilibrium)
    _path(right, forward_map, followed)
    maps = bottom.subplots(1, count + 1, width_ratios=(*(1.0,) * count, 1.25))
    for number, (axes, name) in enumerate(zip(maps, forward_map.electrodes, strict=False)):
        draw_charge_map(axes, forward_map, number)
        title = f"isocharge contours of {name} at 1 N, pC"
        draw_layout(axes, forward_map.sensor, forward_map.domain.radius, title, highlight=name)
    _error_against_force(maps[-1], tested[:, 2], np.hypot(*(tested[:, 3:5] - tested[:, :2]).T))
    figure.suptitle(f"isocharge demo: {forward_map.sensor.name}, {forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)


def _path(axes: Any, forward_map: ForwardMap, followed: Array) -> None:
    for number in np.unique(followed[:, 0]):
        frames = followed[followed[:, 0] == number]
        labels = ("pressed", "estimated") if number == followed[0, 0] else (None, None)
        axes.plot(*frames[:, 1:3].T, color=PRESSED, lw=3.0, solid_capstyle="round", label=labels[0])
        axes.plot(*frames[:, 4:6].T, color=FELT, lw=0.7, label=labels[1])
    axes.legend(loc="upper right")
    draw_layout(axes, forward_map.sensor, forward_map.domain.radius, "live path, through the port")


def _error_against_force(axes: Any, force: Array, error: Array) -> None:
    axes.loglog(force, error, ".", color=PRESSED, ms=2, alpha=0.5)
    edges = np.geomspace(force.min(), force.max(), 13)
    for share, style, label in ((50, "-", "median"), (95, "--", "95 %")):
        line = binned_statistic(force, error, partial(np.percentile, q=share), edges).statistic
        axes.plot(np.sqrt(edges[:-1] * edges[1:]), line, style, color=FELT, label=label)
    axes.legend()
    axes.set(title="position error of test presses", xlabel="force, N", ylabel="error, mm", ylim=(2e-3, None))
    axes.grid(alpha=0.3, which="both")
