"""`isocharge serve plot`: a recording as one picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.terminal import progress, say
from isocharge.common.errors import InputError, RecordingError

if TYPE_CHECKING:
    from isocharge.cli.serve.pictures.recording import Scene
    from isocharge.common.progress import Progress
    from isocharge.common.tables import Table
    from isocharge.serve import Recording
    from isocharge.serve.export.traces import Traces


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

    It shows the records as they were written; no model computes anything. A long recording takes no more memory than a
    short one.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    from isocharge.common.extras import require

    with require("simulate"):
        from isocharge.cli.serve.pictures.recording import recording_picture
        from isocharge.simulate.plots.figure import check_picture, save_picture
    from isocharge.serve import Recording

    check_picture(output)
    recording = Recording(file)
    with progress("reading") as advance:
        traces = _traces(file, recording, advance)
    name = model or recording.model
    figure = recording_picture(traces, _scene(name, models), f"{file.name}, {recording.model}")
    save_picture(figure, output)
    say(f"drawn in {output}: {traces.records} records")


def _traces(file: Path, recording: "Recording", advance: "Progress") -> "Traces":
    """The whole recording, read once.

    Raises:
        RecordingError: If it is damaged, or holds no record.
    """
    from isocharge.serve.export.traces import TraceCollector

    collector: TraceCollector | None = None

    def take(record: "Table") -> None:
        nonlocal collector
        collector = collector or TraceCollector(record)
        collector.add(record)

    recording.for_each_record(take, advance)
    if collector is None:
        raise RecordingError(f"{file}: expected at least one record, got none; replay or record it again")
    return collector.traces()


def _scene(model: str, models: Path | None) -> "Scene":
    """Electrodes and working area, as far as the model has them; a word on stderr where it has not."""
    import numpy as np

    from isocharge.cli.serve.pictures.recording import Scene
    from isocharge.serve import find_model, load_model
    from isocharge.simulate import sensor_from_dict

    try:
        metadata = load_model(find_model(model, models)).metadata
    except InputError as error:
        say(f"drawn without the film, whose model is not to be had: {error}")
        return Scene()
    working_area_mm = np.array(metadata.working_area_mm)
    try:
        return Scene(sensor_from_dict(metadata.sensor, metadata.label), working_area_mm)
    except InputError as error:
        say(f"drawn without electrodes: {error}")
        return Scene(None, working_area_mm)
