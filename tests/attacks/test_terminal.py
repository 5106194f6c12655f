"""Names that attack a terminal: from boards, models, recordings and CSV files, through the commands that print them."""

import contextlib
import io
import json
import logging
import unicodedata
from dataclasses import asdict

import pytest

from boards import received
from isocharge.cli.serve.doctor import brief_report, device_text
from isocharge.cli.shared.terminal import say, show, show_json, show_result, warnings_to_stderr
from isocharge.common.errors import ChargeError, IsochargeError
from isocharge.serve import (
    Chunk,
    Predictor,
    Recorder,
    Recording,
    TouchStream,
    device_from_table,
    load_model,
)
from isocharge.serve.examination.port_check import examine_received
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import find_model
from isocharge.serve.presses.number_columns import CHARGE_RULE
from isocharge.serve.presses.table_file import CsvTable
from isocharge.serve.record.formats import csv_header

HARMFUL_CATEGORIES = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}

CHARACTERS = (
    "\x1b[2J",
    "\x1b]0;title\x07",
    "\x9b31m",
    "B_pC",
    "[red]",
    *"\x07\r\n\t\x00\x7f\u061c\u115f\u200b\u200d\u200e\u202e\u2028\u2066\u3164\ufe0f\ufeff\U000e0041\U000e0101Aé",
)


def foreign_name(rng):
    return "".join(rng.choice(CHARACTERS) for _ in range(rng.choice((1, 2, 3, 12, 60))))


def foreign_names(rng):
    return [foreign_name(rng) for _ in range(3)]


def check_terminal_text(text):
    harmful = {character for character in text if unicodedata.category(character) in HARMFUL_CATEGORIES}
    harmful |= {character for character in text if character in "\u115f\u3164\ufe0f\U000e0101"}
    assert harmful <= {"\n"}, ascii(text)


@contextlib.contextmanager
def checked_terminal():
    """Check all that the block prints, also if it ends with an error, whose message is printed as by a command."""
    stdout, stderr = io.StringIO(newline=""), io.StringIO(newline="")
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            with warnings_to_stderr():
                yield
        except IsochargeError as error:
            say(f"{type(error).__name__}: {error}")
    check_terminal_text(stdout.getvalue())
    check_terminal_text(stderr.getvalue())


def without_separators(names):
    """The names as notations with separators can carry them, so that the lines are recognised as text."""
    for position, name in enumerate(names):
        kept = (character for character in name if character.isprintable() and character not in " :;=,")
        yield "A" + "".join(kept) + str(position)


def json_line(number, names):
    values = {name: 1.5 * position + 0.1 * (number % 3) for position, name in enumerate(names)}
    return json.dumps({"seq": number} | values, ensure_ascii=number % 2 == 0)


def teleplot_lines(number, names):
    return "\n".join(f">{name}:{number}:{1.5 + 0.1 * (number % 3)}§{name}" for name in without_separators(names))


def csv_line(number, names):
    return f"1.5,2.5,{number % 3}" if number else ",".join(names)


def pair_line(number, names):
    return ",".join(f"{name}:{1.5 + 0.1 * (number % 3)}" for name in without_separators(names))


NOTATIONS = {"json": json_line, "teleplot": teleplot_lines, "csv": csv_line, "pairs": pair_line}


def sent(notation, names):
    """Return the bytes of 13 readings with these names of channels."""
    return [f"{NOTATIONS[notation](number, names)}\n".encode() for number in range(13)]


@pytest.mark.parametrize("notation", NOTATIONS)
def test_names_of_a_board_through_the_doctor(notation, attack):
    def read(names):
        with checked_terminal():
            examination = examine_received(received(sent(notation, names), 200.0))
            show_result(brief_report(examination), json=False)
            show_json(asdict(examination))
            comments = [line for line in device_text(examination).splitlines() if line.startswith("#")]
            check_terminal_text("\n".join(comments))

    attack(f"doctor {notation}", read, foreign_names, 100, longest_s=10.0)


@pytest.mark.parametrize("notation", NOTATIONS)
def test_names_of_a_board_through_the_stream(notation, attack):
    predictor = Predictor("three-25um-biaxial")

    def read(names):
        with checked_terminal():
            channels = dict(zip("ABC", names, strict=True))
            device = device_from_table({"name": names[0], "channels": channels}, names[0])
            touch = TouchStream(predictor, device)
            for data in sent(notation, names[::-1] if len(names[0]) > 3 else names):
                for record in touch.feed(Chunk(data, 1.7e9, 0)):
                    show(record.to_json())
            logging.getLogger("isocharge.serve").warning("%s", names)

    attack(f"stream {notation}", read, foreign_names, 2_000)


def read_device_file(names):
    device_from_table({"name": names[0], names[1]: {names[2]: names[0]}, "frames": {"format": names[2]}}, "f")


def read_csv_header(names):
    header = ",".join(["A", "B", "C", *names])
    table = CsvTable([header, "1,2,3,4,5,6"], names[0], ("A", "B", "C"), ChargeError, "")
    table.read(dict.fromkeys("ABC", CHARGE_RULE), {}, 1)


GOOD_PROPS = load_model(find_model("three-25um-biaxial")).metadata.to_props()


def read_metadata(names):
    key = ("electrodes", "sensor", "probes", "name", "noise")[len(names[0]) % 5]
    content = {"electrodes": names, "sensor": {"name": names[0]}, "probes": names, "noise": {names[0]: names[1]}}
    props = GOOD_PROPS | {key: json.dumps(content.get(key, names[0]))}
    metadata = ModelMetadata.from_props(props, names[2])
    show(metadata.label)
    print(csv_header(metadata.electrodes))
    print(metadata.frame_id)


READERS = {"device file": read_device_file, "csv": read_csv_header, "metadata": read_metadata}


@pytest.mark.parametrize("kind", READERS)
def test_names_in_files(kind, attack):
    def read(names):
        with checked_terminal():
            READERS[kind](names)

    attack(f"foreign {kind}", read, foreign_names, 2_000)


def test_recordings(attack, tmp_path):
    path = tmp_path / "foreign.rec"

    def read(names):
        path.unlink(missing_ok=True)
        with checked_terminal():
            with Recorder(path, names[0], {"name": names[1]}, names[2]):
                pass
            recording = Recording(path)
            print(recording.name)
            device_from_table(recording.device, recording.model)

    attack("foreign recording", read, foreign_names, 1_000)
