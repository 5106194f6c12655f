"""`isocharge serve stream` and `serve replay`: compute prediction records from a live port or from a recording."""

import signal
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from isocharge.cli.shared.live_page import (
    AllowHostOption,
    LiveOption,
    PageFeed,
    TlsCertOption,
    TlsKeyOption,
    TokenOption,
    live_page,
)
from isocharge.cli.shared.options import (
    BaudOption,
    DeviceOption,
    ModelArgument,
    ModelsOption,
    PortOption,
    RecordingArgument,
    SecondsOption,
    WaitOption,
)
from isocharge.cli.shared.port_hints import no_frames_hint
from isocharge.cli.shared.terminal import (
    on_signal,
    say,
    stop_timer,
    unless_hung_up,
    until_stopped,
    write_stdout,
)
from isocharge.common.errors import InputError, NoFramesError, error_context, is_printable, shown
from isocharge.common.files import check_new_output
from isocharge.serve import (
    PredictionRecord,
    Predictor,
    Recorder,
    Recording,
    TouchStream,
    device_from_table,
    find_labelled_model,
    find_model,
    load_device,
    open_source,
)
from isocharge.serve.flags import TARE
from isocharge.serve.live.device import switched_on
from isocharge.serve.live.recorded_stream import RecordedStream, replay
from isocharge.serve.outputs.output import OutputContext
from isocharge.serve.outputs.targets import Outputs, target_forms
from isocharge.serve.port.file_source import FileSource
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.thermal import ThermalRule
from isocharge.serve.tracking.tracker import TrackRule

OutputOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TARGET",
        help=f"Where to write the records; repeat the option for several targets. Forms: {target_forms()}. `json` and "
        "`csv` are standard output. Other packages can add forms. (default: json)",
    ),
]


def write_records(records: Iterable[PredictionRecord], writers: Iterable[Callable[[PredictionRecord], object]]) -> None:
    """Pass records to all writers, and print each new tare. If the stream ends without a tare, print the last charges.

    Args:
        records: The records.
        writers: Functions that write a record. The functions are called in the given order.
    """
    is_tare_printed = False
    # Latest charges while the tare is measured, otherwise None. They are printed at the end of a stream without a tare.
    untared_pC: Mapping[str, float | None] | None = None
    try:
        for record in records:
            for write in writers:
                write(record)
            if TARE in record.flags:  # the tare is being measured
                is_tare_printed = False
                untared_pC = record.charge_raw_pC
            elif not is_tare_printed and record.tare_pC is not None:  # an invalid record has no tare
                is_tare_printed = True
                untared_pC = None
                say(f"tared: {_listed(record.tare_pC)}")
    except Exception:
        untared_pC = None  # the error states why the stream has ended, so that `finally` prints nothing
        raise
    finally:  # also after Ctrl-C
        if untared_pC:
            say(
                "caution: no tare, because the stream ended before the film had rested near zero for long enough; the "
                f"last charges are {_listed(untared_pC)}; leave the film alone longer, or state an offset of the board "
                "as offset in [gain]"
            )


def _require_time(record: PredictionRecord) -> None:
    """Raise an error if a record contains no time of the board. Bytes from a file have no arrival times.

    Raises:
        InputError: If the time is missing.
    """
    if record.t_device_us is None:
        raise InputError(
            "a file without times of the board: expected a column t_ms, t_us or t_s, because a correction of leak, hum "
            "or warming, a sum of currents, and tracking need the time between frames; add the column, or play a "
            "recording (--record)"
        )


def _listed(charge_pC: Mapping[str, float | None]) -> str:
    """Return a text with the name and the charge of each electrode whose charge is known."""
    return ", ".join(f"{electrode} {charge:.2f} pC" for electrode, charge in charge_pC.items() if charge is not None)


def command_outputs(targets: Sequence[str] | None, touch: TouchStream, *, is_live: bool) -> Outputs:
    """Return the outputs for the targets of `--output`. The outputs are opened when the context of `Outputs` is
    entered.

    Args:
        targets: Values of the option; None or empty for JSON on standard output.
        touch: The stream whose records are written.
        is_live: Whether the records come from a sensor.

    Raises:
        InputError: If no kind of output accepts a target, or two targets write to standard output.
    """
    context = OutputContext(
        electrodes=touch.predictor.metadata.electrodes,
        sections=touch.sections,
        is_live=is_live,
        write_stdout=write_stdout,
    )
    return Outputs(targets or ["json"], context)


def say_missing_records(outputs: Outputs, state: str) -> None:
    """Print how many records are missing in each output. The outputs must have been closed.

    Args:
        outputs: The outputs. For each incomplete output, `not_written` contains the number of missing records, or None
            if this number is unknown.
        state: Text that is printed for an output whose number of missing records is unknown.
    """
    for target, missing_records in outputs.not_written.items():
        if missing_records is None:
            say(f"{target}: {state}")
        else:
            say(f"{target}: {missing_records} records not written, the oldest: the output was too slow")


def summary(touch: TouchStream) -> str:
    """Return the numbers of frames and faults of a stream."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in asdict(touch.parser.counts).items())


def stream_command(
    model: ModelArgument,
    port: PortOption,
    models: ModelsOption = None,
    device: DeviceOption = None,
    output: OutputOption = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write raw bytes and records for `isocharge serve replay`. (default: no)",
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(
            metavar="TEXT",
            help="Name of this film, the `frame_id` of its records: tells two films on one computer apart. "
            "(default: name of the model's sensor)",
        ),
    ] = None,
    seconds: SecondsOption = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="Number of records after which to stop. (default: at Ctrl-C)")
    ] = None,
    wait: WaitOption = 0.0,
    baud: BaudOption = 115200,
    track: Annotated[
        bool,
        typer.Option(
            "--track",
            help="Follow contacts in time: records get `tracked`, `event` and `other`, as by [track]. (default: off)",
        ),
    ] = False,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Follow the film's pretension by ordinary touches, as by [follow]: records get `film`. Needs four "
            "electrodes or more, and a model of `train calibrate`. (default: off)",
        ),
    ] = False,
    live: LiveOption = None,
    token: TokenOption = None,
    allow_host: AllowHostOption = None,
    tls_cert: TlsCertOption = None,
    tls_key: TlsKeyOption = None,
) -> None:
    """Follow a sensor live: read its port, and print position (mm) and force (N) for every frame of charges.

    The tare (the charges at rest) is measured from the first 100 frames, which take 0.5 s at 200 Hz. Do not touch the
    film meanwhile. The signal SIGUSR1 starts a new tare. The signal SIGHUP loads the latest version of MODEL without
    losing a frame. Ctrl-C stops the command. If the reader of stdout is too slow for a sensor, the oldest lines are
    dropped, and the summary states their number. A recording (--record) is complete even if lines are dropped. The exit
    code is 1 if no frames are recognised within --seconds.

    Example: isocharge serve stream three-25um-biaxial --port /dev/ttyACM0 --seconds 10
    """
    if name is not None and not (name and is_printable(name)):
        raise InputError(f"--name: expected printable characters, got {shown(name)}")

    if record:
        check_new_output(record)

    # Load the model, and set up the stream. The options take precedence over the settings of the device file.
    load_latest = partial(Predictor, model, models=models)
    predictor = load_latest()
    board = load_device(device)
    if track:
        board = switched_on(board, "track")
    if follow:
        board = switched_on(board, "follow")
    touch = TouchStream(predictor, board, frame_id=name)
    new_recorder = partial(Recorder, device=board.table, name=name)
    recorder = new_recorder(record, predictor.metadata.label) if record else None
    stream = RecordedStream(touch)
    has_expired = Event()

    # Write the records of the port to all outputs, until the stream ends or is stopped.
    outputs: Outputs | None = None  # until the port is open
    with (
        until_stopped(),
        live_page(
            live,
            touch.frame_id,
            predictor.metadata,
            token=token,
            tls_cert=tls_cert,
            tls_key=tls_key,
            allow_host=allow_host,
        ) as page,
        stop_timer(seconds, has_expired),
        # The handlers of the signals only request changes, which the stream carries out later.
        on_signal(signal.SIGUSR1, stream.request_tare),
        on_signal(signal.SIGHUP, unless_hung_up(partial(stream.request_model, load_latest))),
        open_source(port, baud=baud, reconnect=True, request=board.request, wait=wait) as source,
        command_outputs(output, touch, is_live=source.is_live) as open_outputs,
        closing(stream.follow(source)) as records,
    ):
        outputs = open_outputs
        stream.request_recording(recorder)
        writers: list[Callable[[PredictionRecord], object]] = [outputs.write]
        if page is not None:
            # The page must not begin a recording if the command itself records the stream.
            writers.append(PageFeed(page, touch, stream, None if recorder else new_recorder).write)
        # The sum of currents, the corrections and tracking need the time between frames.
        needs_time = board.has_currents or not {LeakRule, HumRule, ThermalRule, TrackRule}.isdisjoint(board.rules)
        is_repeatable = isinstance(source, FileSource) and source.is_on_disk
        if needs_time and is_repeatable:
            writers.insert(0, _require_time)  # is called first, and refuses the file at its first record without a time
        say(f"{predictor.metadata.label} on {port}: taring, leave the film alone")
        try:
            with error_context(NoFramesError, after=f"; {no_frames_hint(port, device)}"):
                write_records(islice(records, count), writers)
        finally:
            if not is_repeatable:
                outputs.close()  # otherwise, their incomplete files are removed
            say(summary(touch))

    # Report how the stream has ended.
    if outputs is None:
        say(f"{port}: the command was stopped before the port was open")
        raise typer.Exit(int(has_expired.is_set()))
    has_no_frames = not touch.parser.counts.frames
    if has_no_frames:
        say(f"no frames were recognised; {no_frames_hint(port, device)}")
    say_missing_records(outputs, "incomplete")
    is_recording_incomplete = recorder and recorder.failed
    has_waited_in_vain = has_no_frames and has_expired.is_set()
    if is_recording_incomplete or outputs.has_incomplete_file or has_waited_in_vain:
        raise typer.Exit(1)


def replay_command(
    file: RecordingArgument,
    model: Annotated[
        str | None,
        typer.Option(metavar="MODEL", help="Model to use, name or path. (default: that of the recording)"),
    ] = None,
    models: ModelsOption = None,
    device: DeviceOption = None,
    real_time: Annotated[
        bool, typer.Option("--real-time/--fast", help="Play at the pace of the recording, or as fast as possible.")
    ] = False,
    output: OutputOption = None,
    live: LiveOption = None,
    token: TokenOption = None,
    allow_host: AllowHostOption = None,
    tls_cert: TlsCertOption = None,
    tls_key: TlsKeyOption = None,
) -> None:
    """Play a recording of raw bytes again: the same model and device give the same records, bit for bit.

    If the recorded description of the board was wrong, replace it with --device. With --live, the recording can be
    played on a page at any speed, until Ctrl-C.

    Example: isocharge serve replay touch.rec --real-time
    """
    # The model, the board and the name of the film are those of the recording, unless an option replaces them.
    recording = Recording(file)
    folder = find_model(model, models) if model else find_labelled_model(recording.model, models)
    predictor = Predictor(folder)
    board = load_device(device) if device else device_from_table(recording.device, str(file))

    # If the model was changed during the recording, the replay changes the model, too. It then calls
    # `load_changed_model` with the label of the new model. A model that the user has chosen is never changed.
    touch = TouchStream(predictor, board, frame_id=recording.name)  # `recording.name` is the name of the film
    load_changed_model = None if model else lambda label: Predictor(find_labelled_model(label, models))

    # The function `play` yields the records. Without --device, it yields as many records as the recording contains.
    # Another description of the board may give more frames, so `yields_all` then requests all records.
    play = partial(replay, recording, touch, real_time=real_time, yields_all=bool(device), load=load_changed_model)

    outputs = command_outputs(output, touch, is_live=False)
    with (
        until_stopped(),
        live_page(
            live,
            file.name,
            predictor.metadata,
            is_recording=True,
            token=token,
            tls_cert=tls_cert,
            tls_key=tls_key,
            allow_host=allow_host,
        ) as page,
        outputs,
    ):
        if page is None:
            write_records(play(), [outputs.write])
        else:
            feed = PageFeed(page, touch)
            write_records(play(on_marker=page.add_marker), [outputs.write, feed.write])
            outputs.close()  # before the page waits for Ctrl-C, because Ctrl-C discards files that are still open
            feed.update_state()  # with the counters of the whole recording
            page.update(is_complete=True)
            threading.Event().wait()  # sleeps until Ctrl-C, because nothing sets the event
    say(summary(touch))
    if outputs.has_incomplete_file:  # the replay was stopped before its end, for example by Ctrl-C
        say_missing_records(outputs, "not written, because the replay was stopped before its end")
        raise typer.Exit(1)
