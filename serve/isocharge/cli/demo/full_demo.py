"""Complete demo: simulate a film, train a model, follow a virtual sensor, and draw the results."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.stats import binned_statistic

from isocharge.cli.demo.played_area import DEFAULT_SENSOR, played_radius_mm
from isocharge.cli.shared.terminal import say, show, shown_progress, this_command
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.arrays import Array
from isocharge.common.files import new_folder
from isocharge.common.progress import track
from isocharge.serve import Port, PredictionRecord, Predictor, TouchStream, find_model, load_model
from isocharge.serve.benchmark import in_process_contenders, press_charges, take_turns
from isocharge.serve.live.stream import StreamTotals
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
from isocharge.train.data.contact_errors import ContactErrorStatistics, position_error

SAMPLES = 24_000
"""Number of presses on which the model is trained."""

SEED = 0
"""Seed of the presses of training and of the live part."""

RATE_HZ = 200.0
"""Frames per second of the virtual sensor, Hz."""

LIVE_S = 10.0
"""Duration of the live part, s."""

PRINT_INTERVAL_S = 0.5
"""Time between two printed lines of the live part, s."""

DRAWN_POSITION_MM = (3.0, -2.0)
"""Position of the press whose deflection is drawn, mm."""

DRAWN_FORCE_N = 1.0
"""Force of the press whose deflection is drawn, N."""

TEST_PRESSES = 4096
"""Number of presses, with another seed, on which the errors are measured."""

LATENCY_S = 0.5
"""Time for which the latency of a prediction is measured, s."""


class FollowedFrame(NamedTuple):
    """Frame of the live part in which both the virtual sensor and the model report a contact.

    Attributes:
        press_number: Number of the press to which the frame belongs, counted from 1.
        true_x_mm, true_y_mm, true_force_N: True contact, which the virtual sensor plays.
        x_mm, y_mm, force_N: Contact that the model estimates.
    """

    press_number: int
    true_x_mm: float
    true_y_mm: float
    true_force_N: float
    x_mm: float
    y_mm: float
    force_N: float


def run_demo(output: Path | None, seconds: float | None, config: Path | None, sensor_name: str | None = None) -> None:
    """Run the demo, print a table of its results, and write the dataset, the model and a picture into a new folder.

    Args:
        output: The folder; None for the first free name of demo-output, demo-output-2, ...
        seconds: Duration of the live part, s; None for `LIVE_S`.
        config: Training settings, TOML; None for those of the released models.
        sensor_name: Name of the simulated sensor and of the model that is trained; None for `DEFAULT_SENSOR`.
    """
    settings = load_config(config) if config else None
    folder = output or _free_name(Path("demo-output"))
    sensor = load_sensor(sensor_name or DEFAULT_SENSOR)
    probe = Circle(1.0)
    sweep = Sweep(played_radius_mm(sensor.name), samples=SAMPLES, seed=SEED)
    durations_s: dict[str, float] = {}
    with new_folder(folder) as draft:
        with _demo_step(
            "simulate", f"{sensor.name}, circle of 1 mm, 0.05 to 2 N, within {sweep.radius:.3g} mm", durations_s
        ):
            # The forward map interpolates the charges of all presses. There is one map for each probe.
            (forward_map,) = solve_maps(sensor, (probe,), sweep)
            dataset = read_dataset(write_sweep(draft / "presses", (forward_map,), sweep))
            say(
                f"   {len(dataset.samples)} presses interpolated from {forward_map.solves} solves, relative error "
                f"{forward_map.error:.1e}"
            )
        with _demo_step("train", "a small network on noisy charges, exported to ONNX", durations_s):
            model = release(fit(dataset, settings), draft / "models" / sensor.name, command=this_command())
            predictor = Predictor(model.folder)
            say(f"   median position error {model.metadata.errors['position_median_mm']:g} mm with noise")
        with _demo_step(
            "serve",
            f"a virtual sensor sends {RATE_HZ:g} frames/s over a pseudo-terminal, the model answers live",
            durations_s,
        ):
            followed, totals = _follow_live(forward_map, predictor, seconds or LIVE_S)
            say(f"   {totals.frames} frames, {totals.lost} lost, {totals.repeated} repeated")
        with _demo_step("show", "one page of pictures", durations_s):
            tested = _test_presses(forward_map, predictor, sweep)
            equilibrium = press(forward_map.sensor.film, forward_map.probe, DRAWN_POSITION_MM, DRAWN_FORCE_N)
            draw_page(forward_map, equilibrium, followed, tested, draft / "demo.png")
    say(f"   {folder / 'demo.png'}")
    show(_summary(tested, followed, durations_s, folder / "models" / sensor.name))


@contextmanager
def _demo_step(name: str, description: str, durations_s: dict[str, float]) -> Iterator[None]:
    """Context manager that prints the title of one step of the demo and shows the progress of the step.

    Args:
        name: Name of the step.
        description: What the step does.
        durations_s: Durations of the completed steps by name, s. The duration of this step is added.
    """
    step_number = len(durations_s) + 1
    say(f"\n{step_number}. {name}: {description}")
    start_s = time.perf_counter()
    with shown_progress():
        yield
    durations_s[name] = time.perf_counter() - start_s


def _free_name(base: Path) -> Path:
    """Return the first path of the sequence base, base-2, base-3, ... that does not exist."""
    numbered_paths = (base.with_name(f"{base.name}-{number}") for number in count(2))
    return next(path for path in chain([base], numbered_paths) if not path.exists())


def _follow_live(forward_map: ForwardMap, predictor: Predictor, seconds: float) -> tuple[Array, StreamTotals]:
    """Play a virtual sensor, read its port, and print the estimated and the true contact at regular intervals.

    Args:
        forward_map: Charges of the presses of the virtual sensor.
        predictor: The model that estimates the contacts.
        seconds: Duration, s.

    Returns:
        Two values. The first is an array of the frames in which both the virtual sensor and the model have a contact,
        shape (n, 7), mm and N: number of the press, true (x, y, F) and estimated (x, y, F), as in `FollowedFrame`. The
        second contains the counts of all frames of the stream.
    """
    touch = TouchStream(predictor)
    frame_count = round(seconds * RATE_HZ)
    print_interval = round(PRINT_INTERVAL_S * RATE_HZ)
    followed: list[FollowedFrame] = []
    press_number = 0
    is_pressed = False
    say("   estimated: x mm, y mm, N   true: x mm, y mm, N")
    with virtual_sensor(forward_map, "reference", SEED, RATE_HZ) as sensor, Port(sensor.url) as port:
        all_records = (record for chunk in port for record in touch.feed(chunk))
        records = islice(all_records, frame_count)
        for frame_number, record in enumerate(track(records, "following", frame_count), start=1):
            truth = sensor.truth(record.seq or 0)  # the press that the virtual sensor played in this frame
            true_contact = (truth.x_mm, truth.y_mm, truth.force_N)
            contact = _contact_of(record)

            # A press lasts as long as both the virtual sensor and the model have a contact. A new press has a new
            # number.
            was_pressed = is_pressed
            is_pressed = record.contact and truth.force_N > 0.0
            if is_pressed and not was_pressed:
                press_number += 1
            if is_pressed:
                followed.append(FollowedFrame(press_number, *true_contact, *contact))
            if frame_number % print_interval == 0:
                estimated_columns = _contact_columns(record.contact, contact)
                true_columns = _contact_columns(truth.force_N > 0.0, true_contact)
                say(f"   {estimated_columns}     {true_columns}")
    return np.array(followed), touch.totals()


def _contact_of(record: PredictionRecord) -> tuple[float, float, float]:
    """Return x (mm), y (mm) and the force (N) of a record. A value that the record does not contain is 0."""
    return record.x_mm or 0.0, record.y_mm or 0.0, record.force_N or 0.0


def _contact_columns(is_contact: bool, contact: tuple[float, float, float]) -> str:
    """Format a contact for the table of the live part.

    Args:
        is_contact: Whether there is a contact. Otherwise the text "no contact" is returned.
        contact: Position x and y, mm, and force, N.
    """
    if not is_contact:
        return f"{'no contact':>22}"
    x_mm, y_mm, force_N = contact
    return f"{x_mm:7.2f} {y_mm:7.2f} {force_N:6.3f}"


def _test_presses(forward_map: ForwardMap, predictor: Predictor, sweep: Sweep) -> Array:
    """Estimate the contacts of presses on which the model was not trained.

    Args:
        forward_map: Charges of the presses.
        predictor: The model that estimates the contacts.
        sweep: Settings of the presses on which the model was trained. The test presses have another seed.

    Returns:
        True and estimated (x, y, F), shape (TEST_PRESSES, 6), mm and N.
    """
    test_sweep = Sweep(sweep.radius, sweep.force_range, TEST_PRESSES, sweep.seed + 1)
    true_contact = test_sweep.over((forward_map.probe,)).contact
    clean_charge_pC = forward_map.charges(true_contact)
    noisy_charge_pC = noise_model("reference").add(clean_charge_pC, np.random.default_rng(test_sweep.seed))
    estimates = predictor.predict_batch(noisy_charge_pC)
    return np.column_stack([true_contact, estimates.x_mm, estimates.y_mm, estimates.force_N])


def _position_error(presses: Array) -> Array:
    """Compute the distances between the true and the estimated positions of presses.

    Args:
        presses: Rows that end with the true (x, y, F) and the estimated (x, y, F), shape (n, 6) or (n, 7), mm and N.

    Returns:
        Distances, shape (n,), mm.
    """
    true_contact = presses[:, -6:-3]
    estimated_contact = presses[:, -3:]
    return position_error(estimated_contact, true_contact)


def _position_error_text(presses: Array) -> str:
    """Format the median and the 95th percentile of the position error.

    Args:
        presses: Rows that end with the true (x, y, F) and the estimated (x, y, F), shape (n, 6) or (n, 7), mm and N.
    """
    median_mm, p95_mm = np.percentile(_position_error(presses), (50, 95))
    return f"median {median_mm:.3f} mm, 95 % {p95_mm:.3f} mm"


def _summary(tested: Array, followed: Array, durations_s: dict[str, float], model_folder: Path) -> str:
    """Measure the latency of the model, and return the table of the results of the demo.

    Args:
        tested: Test presses, true and estimated (x, y, F), shape (m, 6), mm and N.
        followed: Frames of the live part, shape (n, 7), mm and N: number of the press, true and estimated (x, y, F).
        durations_s: Duration of each step by its name, s.
        model_folder: Folder of the model, which is `models/NAME` in the folder of the results.
    """
    true_contact, estimated_contact = np.split(tested, 2, axis=1)  # each of shape (m, 3)
    errors = ContactErrorStatistics.of(estimated_contact, true_contact)

    # Measure the latency of one kind of call only: the prediction of a single press from a list of charges.
    model = load_model(find_model(str(model_folder)))
    predictor = Predictor(model.folder)
    charges = press_charges(predictor, model.golden.charge_pC)
    _press_from_array, press_from_list, *_batches = in_process_contenders(predictor, charges)
    (latency,) = take_turns([press_from_list], LATENCY_S)

    size_KiB = (model.folder / "model.onnx").stat().st_size / 1024
    results_folder = model_folder.parent.parent
    rows = [
        ("position error, with noise", _position_error_text(tested)),
        ("position error, live", _position_error_text(followed)),
        ("force error", f"median {errors.force_median_percent:.2f} %, rms {errors.force_rms_percent:.2f} %"),
        ("model", f"{size_KiB:.0f} KiB, {model.metadata.label}"),
        ("one prediction", f"p50 {latency.p50_us:.1f} us, p99 {latency.p99_us:.1f} us"),
        ("seconds", ", ".join(f"{name} {duration:.1f}" for name, duration in durations_s.items())),
        ("results in", str(results_folder)),
    ]
    return "\n" + "\n".join(f"{name:<32} {value}" for name, value in rows)


def draw_page(forward_map: ForwardMap, equilibrium: Equilibrium, followed: Array, tested: Array, path: Path) -> None:
    """Draw the results of the demo on one page, and write the page as a picture.

    Args:
        forward_map: Forward map of the film.
        equilibrium: The press whose deflection is drawn.
        followed: Frames of the live part, shape (n, 7), mm and N: number of the press, true and estimated (x, y, F).
        tested: Test presses, true and estimated (x, y, F), shape (m, 6), mm and N.
        path: Path of the picture, which is written.
    """
    electrode_count = len(forward_map.electrodes)
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))

    # Upper row: the film under one press, a section through it, and the paths of the live part.
    left, middle, right = top.subplots(1, 3)
    draw_deflection(left, equilibrium)
    draw_electrodes(left, forward_map.sensor, names=False)
    draw_section(middle, equilibrium)
    _draw_live_paths(right, forward_map, followed)

    # Lower row: a map of the charge of each electrode, and the errors of the test presses, which get more width.
    width_ratios = [1.0] * electrode_count + [1.25]
    *map_axes, error_axes = bottom.subplots(1, electrode_count + 1, width_ratios=width_ratios)
    for electrode_index, (axes, name) in enumerate(zip(map_axes, forward_map.electrodes, strict=True)):
        draw_charge_map(axes, forward_map, electrode_index)
        title = f"isocharge contours of {name} at 1 N, pC"
        draw_layout(axes, forward_map.sensor, forward_map.domain.radius, title, highlight=name)
    true_force = tested[:, 2]
    _draw_error_against_force(error_axes, true_force, _position_error(tested))
    figure.suptitle(f"isocharge demo: {forward_map.sensor.name}, {forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)


def _draw_live_paths(axes: Any, forward_map: ForwardMap, followed: Array) -> None:
    """Draw the true and the estimated path of each press of the live part.

    Args:
        axes: Axes of matplotlib.
        forward_map: Forward map of the film, whose layout is drawn.
        followed: Frames of the live part, shape (n, 7), mm and N: number of the press, true and estimated (x, y, F),
            with the names of `FollowedFrame`. There must be at least one press.
    """
    columns = dict(zip(FollowedFrame._fields, followed.T, strict=True))
    for press_number in np.unique(columns["press_number"]):
        is_in_press = columns["press_number"] == press_number  # mask of the frames of this press
        true_path = (columns["true_x_mm"][is_in_press], columns["true_y_mm"][is_in_press])
        estimated_path = (columns["x_mm"][is_in_press], columns["y_mm"][is_in_press])
        axes.plot(*true_path, color=PRESSED, lw=3.0, solid_capstyle="round")
        axes.plot(*estimated_path, color=FELT, lw=0.7)

    # Only the two lines of the first press get labels, so that the legend has two entries.
    true_line, estimated_line = axes.lines[:2]
    true_line.set_label("pressed")
    estimated_line.set_label("estimated")
    axes.legend(loc="upper right")
    draw_layout(axes, forward_map.sensor, forward_map.domain.radius, "live path, through the port")


def _draw_error_against_force(axes: Any, force: Array, error: Array) -> None:
    """Draw the position errors of presses against their forces, with the median and the 95th percentile.

    Args:
        axes: Axes of matplotlib.
        force: Forces of the presses, shape (n,), N.
        error: Position errors of the presses, shape (n,), mm.
    """
    axes.loglog(force, error, ".", color=PRESSED, ms=2, alpha=0.5)

    # The percentiles are computed in 12 ranges of force, which have the same width on the logarithmic axis.
    bin_edges = np.geomspace(force.min(), force.max(), num=13)
    bin_centres = np.sqrt(bin_edges[:-1] * bin_edges[1:])  # geometric means of neighbouring edges
    for percentile, line_style, label in ((50, "-", "median"), (95, "--", "95 %")):
        bin_errors = binned_statistic(force, error, partial(np.percentile, q=percentile), bin_edges).statistic
        axes.plot(bin_centres, bin_errors, line_style, color=FELT, label=label)
    axes.legend()
    axes.set(title="position error of test presses", xlabel="force, N", ylabel="error, mm", ylim=(2e-3, None))
    axes.grid(alpha=0.3, which="both")
