"""CSV file of a press session, with a second file that states on which sensor the presses are made.

The file `presses.csv` contains the measured presses, and is replaced as a whole after each press. The file is therefore
complete at any time, so that an interrupted session can be continued.

The file `.presses.csv.session.json` contains the sensor and the probe of the session. The content of this file prevents
a session from being continued with another sensor or probe. The process that takes presses locks this file, so that no
other process writes to the file of presses.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from isocharge.common.errors import OutputError, PressError
from isocharge.common.files import as_output_errors, write_whole
from isocharge.common.measured_presses import MeasuredPresses, read_presses, write_presses
from isocharge.common.resumable_run import locked
from isocharge.common.structs import read_json
from isocharge.simulate import Probe, Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict


class PressFile:
    """File of the presses of one sensor and one probe; `open_press_file` creates it.

    Attributes:
        path: The file of presses.
    """

    def __init__(self, path: Path, sensor: Sensor) -> None:
        self.path = path
        self._sensor = sensor

    def read(self, *, position_std_mm: float, force_std: float) -> MeasuredPresses | None:
        """Return the presses of an earlier session, or None if there are none.

        Args:
            position_std_mm: Standard deviation of x and y of presses for which the file states none, mm.
            force_std: Standard deviation of the force of such presses, relative to the force.

        Raises:
            PressError: If the file is not a file of presses, or if it has further columns, which would be lost.
        """
        if not self.path.exists():
            return None
        presses = read_presses(
            self.path, self._sensor.electrode_names, position_std_mm=position_std_mm, force_std=force_std
        )
        if presses.ignored:
            raise PressError(
                f"{self.path}: expected a file of `isocharge train press`, got further columns: "
                f"{', '.join(presses.ignored)}; they would be lost, so choose another output"
            )
        return presses

    def write(self, presses: MeasuredPresses) -> None:
        """Write all presses to the file, or delete the file if there are no presses.

        Args:
            presses: All presses of the session.

        Raises:
            OutputError: If the file cannot be written. The previous file then remains.
        """
        if len(presses):
            write_presses(self.path, presses)
            return
        with as_output_errors(self.path):
            self.path.unlink(missing_ok=True)


@contextmanager
def open_press_file(path: Path, sensor: Sensor, probe: Probe, *, fresh: bool = False) -> Iterator[PressFile]:
    """Open a file of presses for one session, and lock it until the `with` block ends.

    A hidden file beside the presses states the sensor and the probe, and carries the lock. The hidden file is removed
    if no presses were written.

    Args:
        path: The file, in the format CSV, or Parquet if its name ends in `.parquet`. It may contain the presses of an
            earlier session.
        sensor: Sensor on which the presses are made.
        probe: Probe with which the presses are made.
        fresh: Whether to delete the presses of an earlier session.

    Raises:
        PressError: If the presses in the file were made on another sensor or with another probe.
        OutputExists: If another process takes presses into this file.
        OutputError: If the file cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: expected a file for the presses, got a folder or a device; choose another output")
    content = json.dumps({"sensor": sensor_to_dict(sensor), "probe": probe.notation}).encode()
    subject = json.loads(content)  # with the types of JSON, for the comparison with the file of an earlier session
    session_path = path.with_name(f".{path.name}.session.json")

    with as_output_errors(path):
        if not session_path.exists():
            write_whole(session_path, content)
        with locked(session_path):
            try:
                # The presses of an earlier session are kept if they were made on the same sensor with the same probe.
                if fresh:
                    path.unlink(missing_ok=True)
                if path.exists():
                    _check_same_subject(path, session_path, subject)
                else:
                    session_path.write_bytes(content)  # in place, because a new file would not be locked
                yield PressFile(path, sensor)
            finally:
                if not path.exists():
                    session_path.unlink(missing_ok=True)


def _check_same_subject(path: Path, session_path: Path, subject: dict[str, Any]) -> None:
    """Raise PressError if the presses of a file were made on another sensor or with another probe."""
    earlier = read_json(session_path, "the sensor and the probe of a press session", PressError, dict[str, Any])
    differing = [name for name, value in subject.items() if earlier.get(name) != value]
    if differing:
        raise PressError(
            f"{path}: expected presses of this sensor and probe, got presses of another "
            f"{' and another '.join(differing)}; continue with the same sensor and probe, choose another output, or "
            "delete the presses with --fresh"
        )
