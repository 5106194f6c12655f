"""`isocharge serve plot`: a recording as one picture."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.errors import InputError
from isocharge.common.extras import require
from isocharge.serve import Recording, find_model, load_model

with require("simulate"):
    from isocharge.cli.serve.recording_picture import RecordFields, recording_picture, traces_of
    from isocharge.simulate.plots.figure import check_picture, save_picture
    from isocharge.simulate.sensor.sensor_file import sensor_from_dict


def plot_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PICTURE", help="New picture to draw: .png, .svg or .pdf.")
    ],
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Model that describes the film, name or path. (default: that of the recording)",
        ),
    ] = None,
    models: ModelsOption = None,
) -> None:
    """Draw a recording: the path on the film (mm), position, force (N) and charges (pC) over time, flags.

    It shows the records as they were written; no model computes anything.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    check_picture(output)
    recording = Recording(file)
    with shown_progress():
        traces = traces_of(recording.records(RecordFields), str(file))
    sensor = working_area = None
    try:
        metadata = load_model(find_model(model or recording.model, models)).metadata
        working_area = np.array(metadata.working_area_mm)
        sensor = sensor_from_dict(metadata.sensor, metadata.label)
    except InputError as error:
        missing = "the film, whose model is not to be had" if working_area is None else "electrodes"
        say(f"drawn without {missing}: {error}")
    save_picture(recording_picture(traces, sensor, working_area, f"{file.name}, {recording.model}"), output)
    say(f"drawn in {output}: {len(traces['timestamp'])} records")
