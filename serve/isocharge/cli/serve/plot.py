"""`isocharge serve plot`: draw the charges, the position, the force and the flags of a recording over time."""

from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure

from isocharge.cli.shared.options import RecordingArgument
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.errors import RecordingError
from isocharge.common.files import as_output_errors
from isocharge.serve import PredictionRecord, Recording
from isocharge.serve.viewer.tape import FLAG_BITS, Samples, sample_type, sample_values
from isocharge.simulate.plots.figure import COLOURS, INK, check_picture, new_figure, save_picture


def plot_command(
    file: RecordingArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PICTURE", help="New picture to draw: .png, .svg or .pdf.")
    ],
) -> None:
    """Draw the charges (pC), the position (mm), the force (N) and the flags of a recording over time.

    The picture shows the records as they were written. No contacts are computed again.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    check_picture(output)
    recording = Recording(file)
    with shown_progress():
        samples = recorded_samples(recording, str(file))
    with as_output_errors(output):
        save_picture(recording_picture(samples, f"{file.name}, {recording.model}"), output)
    say(f"drawn in {output}: {len(samples)} records")


def recorded_samples(recording: Recording, where: str) -> Samples:
    """Return the n records of a recording as samples, shape (n,), as the live page draws them.

    The names of the electrodes are taken from the first record.

    Args:
        recording: The recording.
        where: Name of the recording, for the error message.

    Raises:
        RecordingError: If there are no records.
    """
    records = recording.records(PredictionRecord)
    first = next(records, None)
    if first is None:
        raise RecordingError(f"{where}: expected at least one record, got none; replay or record it again")
    electrodes = tuple(first.charge_raw_pC or ())  # the keys are the names of the electrodes
    # A row has the numbers of one record, in the order of the fields that `sample_type` declares.
    rows = (sample_values(record, electrodes) for record in chain([first], records))
    return np.fromiter(rows, sample_type(electrodes))


def recording_picture(samples: Samples, title: str) -> Figure:
    """Return a picture of a recording. Each value is drawn as a point, so that a time without records remains empty.

    Args:
        samples: Samples of the records, as `recorded_samples` returns them.
        title: Names of the file and the model.
    """
    start_s = samples["timestamp"][0]
    time_s = samples["timestamp"] - start_s
    flag_bits = samples["flags"].astype(int)
    # Times of the records with each flag that occurs, by the name of the flag
    flag_times_s = {flag: time_s[(flag_bits & bit) > 0] for flag, bit in FLAG_BITS.items() if (flag_bits & bit).any()}
    figure = new_figure(12.0, 8.6)
    figure.suptitle(f"{title}: {len(time_s)} records; faint points: ± 2 standard deviations", parse_math=False)
    charge_axes, position_axes, force_axes, flag_axes = figure.subplots(
        4, 1, sharex=True, height_ratios=(1.0, 1.0, 0.8, 0.1 * (1 + len(flag_times_s)))
    )

    charge_axes.set_prop_cycle(color=COLOURS)
    for name in samples.dtype.names or ():
        if name.startswith("charge_pC."):  # one column of charges for each electrode
            charge_axes.plot(time_s, samples[name], ".", ms=2.0, label=name.removeprefix("charge_pC."))
    for quantity, unit, axes in (("x", "mm", position_axes), ("y", "mm", position_axes), ("force", "N", force_axes)):
        values = samples[f"{quantity}_{unit}"]
        two_std = 2.0 * samples[f"{quantity}_std_{unit}"]
        (points,) = axes.plot(time_s, values, ".", ms=2.0, label=quantity)
        for limit in (values - two_std, values + two_std):
            axes.plot(time_s, limit, ".", ms=1.0, alpha=0.3, color=points.get_color())
    for row, flag_time_s in enumerate(flag_times_s.values()):  # a row of marks for each flag
        flag_axes.plot(flag_time_s, np.full(len(flag_time_s), row), "|", color=INK)

    n_flag = len(flag_times_s)
    flag_axes.set(yticks=range(n_flag), yticklabels=flag_times_s, ylim=(-0.7, max(n_flag, 1) - 0.3))
    flag_axes.set_xlabel(f"time since {datetime.fromtimestamp(start_s, UTC):%Y-%m-%d %H:%M:%S} UTC, s")
    labels = {charge_axes: "touch charge, pC", position_axes: "position, mm", force_axes: "force, N"}
    for axes, label in labels.items():
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        handles, _ = axes.get_legend_handles_labels()
        if handles:  # the legend is above the axes, at the right
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, ncols=8, markerscale=4.0)
    return figure
