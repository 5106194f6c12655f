"""Complete demo: simulate a film, train a model, follow a virtual sensor, and draw the results."""

from itertools import islice
from pathlib import Path
from typing import cast

import numpy as np

from isocharge.cli.demo.live_film import DEMO_SENSOR
from isocharge.cli.serve.stream import summary
from isocharge.cli.shared.forward_maps import N_SIMULATED_PRESSES
from isocharge.cli.shared.terminal import say, show_result, shown_progress, this_command
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.arrays import Array
from isocharge.common.files import new_folder
from isocharge.common.progress import track
from isocharge.serve import Port, Predictor, TouchStream
from isocharge.simulate import Circle, Equilibrium, ForwardMap, Sweep, load_sensor, press, read_dataset
from isocharge.simulate.dataset.sweep import solve_maps, write_sweep
from isocharge.simulate.plots.figure import FELT, PRESSED, new_figure, save_picture
from isocharge.simulate.plots.film import (
    draw_charge_map,
    draw_deflection,
    draw_electrodes,
    draw_layout,
    draw_section,
)
from isocharge.train import fit, release
from isocharge.train.data.contact_errors import position_error

FOLLOWED_FRAMES = 2000
"""Number of frames of the live part. The virtual sensor sends 200 frames per second."""


def run_demo(folder: Path) -> None:
    """Run the demo, print a table of its results, and write the dataset, the model and a picture into a new folder.

    Args:
        folder: The folder.
    """
    sensor = load_sensor(DEMO_SENSOR)
    probe = Circle(1.0)
    sweep = Sweep(samples=N_SIMULATED_PRESSES)
    with shown_progress(), new_folder(folder) as draft:
        say(f"1. simulate: {sensor.name}, circle of 1 mm, 0.05 to 2 N, within {sweep.radius:.3g} mm")
        # The forward map interpolates the charges of all presses. There is one map for each probe.
        (forward_map,) = solve_maps(sensor, (probe,), sweep)
        dataset = read_dataset(write_sweep(draft / "presses", (forward_map,), sweep))
        say(
            f"   {len(dataset.samples)} presses interpolated from {forward_map.solves} solves, relative error "
            f"{forward_map.error:.1e}"
        )
        say("2. train: a small network on noisy charges, exported to ONNX")
        model = release(fit(dataset), draft / "models" / sensor.name, command=this_command())
        predictor = Predictor(model.folder)
        say("3. serve: a virtual sensor sends frames over a pseudo-terminal, the model answers live")
        followed = _follow_live(forward_map, predictor)
        say("4. show: one page of pictures")
        equilibrium = press(sensor.film, probe, (3.0, -2.0), 1.0)  # a press inside every working area
        draw_page(forward_map, equilibrium, followed, draft / "demo.png")
    say(f"   {folder / 'demo.png'}")

    # `followed` has the shape (n, 2, 3): for each frame, the true and the estimated contact (x, y, F).
    true_contacts = followed[:, 0]
    estimated_contacts = followed[:, 1]
    live_median_mm, live_p95_mm = np.percentile(position_error(estimated_contacts, true_contacts), (50, 95))
    results = {
        "model": predictor.metadata.label,
        "errors": predictor.metadata.errors,
        "live_errors": {"position_median_mm": live_median_mm, "position_p95_mm": live_p95_mm},
        "folder": str(folder),
    }
    show_result(results)


def _follow_live(forward_map: ForwardMap, predictor: Predictor) -> Array:
    """Play a virtual sensor, estimate its contacts from the frames at its port, and print the counts of the frames.

    Args:
        forward_map: Charges of the presses of the virtual sensor.
        predictor: The model that estimates the contacts.

    Returns:
        The true and the estimated contact (x, y, F) of each frame in which both exist, shape (n, 2, 3), mm and N.
    """
    touch = TouchStream(predictor)
    followed = []  # pairs of a true and an estimated contact
    with virtual_sensor(forward_map) as sensor, Port(sensor.url) as port:
        all_records = (record for chunk in port for record in touch.feed(chunk))
        records = islice(all_records, FOLLOWED_FRAMES)
        script = sensor.script
        for record in track(records, "following", FOLLOWED_FRAMES):
            # The virtual sensor repeats a script, which has one row with the true contact for each frame. The time of
            # the frame gives its number since the start. The remainder is its row in the script.
            row = round(1e-6 * (record.t_device_us or 0) * script.rate_Hz) % len(script.contact)
            if record.contact and script.touching[row]:
                followed.append((script.contact[row], (record.x_mm, record.y_mm, record.force_N)))
    say(f"   {summary(touch)}")
    return np.array(followed, float)


def draw_page(forward_map: ForwardMap, equilibrium: Equilibrium, followed: Array, path: Path) -> None:
    """Draw the results of the demo on one page, and write the page as a picture.

    Args:
        forward_map: Forward map of the film.
        equilibrium: The press whose deflection is drawn.
        followed: True and estimated contacts of the live part, shape (n, 2, 3), mm and N.
        path: Path to which the picture is written.
    """
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))

    # Upper row: the film under one press, a section through it, and the paths of the live part.
    left, middle, right = top.subplots(1, 3)
    draw_deflection(left, equilibrium)
    draw_electrodes(left, forward_map.sensor, names=False)
    draw_section(middle, equilibrium)
    true_contact, contact = followed.transpose(1, 2, 0)  # each of shape (3, n)
    right.plot(true_contact[0], true_contact[1], ".", color=PRESSED, ms=1.5, zorder=3, label="pressed")
    right.plot(contact[0], contact[1], ".", color=FELT, ms=3.0, label="estimated")
    right.legend(loc="upper right")
    draw_layout(right, forward_map.sensor, forward_map.domain.radius, "live contacts, through the port")

    # Lower row: a map of the charge of each electrode.
    all_axes = bottom.subplots(1, len(forward_map.electrodes))
    for electrode_index, (axes, name) in enumerate(zip(all_axes, forward_map.electrodes, strict=True)):
        draw_charge_map(axes, forward_map, electrode_index)
        title = f"isocharge contours of {name} at 1 N, pC"
        draw_layout(axes, forward_map.sensor, forward_map.domain.radius, title, highlight=name)
    figure.suptitle(f"isocharge demo: {forward_map.sensor.name}, {forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)
