"""CSV file of a press session, with a second, hidden file for the sensor and the probe of the session.

The file `presses.csv` contains the measured presses. After each press, the whole file is replaced. Therefore, the file
is always complete, and an interrupted session can be continued.

The hidden file `.presses.csv.session.json` contains the sensor and the probe of the session. Before a session is
continued, its sensor and probe are compared with the content of the hidden file. The process that runs the session
locks the hidden file. Therefore, no other process can write to `presses.csv` at the same time.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from isocharge.common.errors import OutputError, PressError
from isocharge.common.files import as_output_errors, locked, write_whole
from isocharge.common.structs import read_json
from isocharge.serve.presses.measured_presses import MeasuredPresses, read_presses, write_presses
from isocharge.simulate import Probe, Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict


class PressFile:
    """File that contains presses on one sensor with one probe; see `open_press_file`.

    Attributes:
        path: Path of the file of presses.
    """

    def __init__(self, path: Path, sensor: Sensor) -> None:
        self.path = path
        self._sensor = sensor

    def read(self, *, position_std_mm: float, force_std: float) -> MeasuredPresses | None:
        """Return the presses of an earlier session, or None if there is no earlier session.

        Args:
            position_std_mm: Standard deviation of x and y of a press if the file does not contain it, mm.
            force_std: Standard deviation of the force of a press if the file does not contain it, relative to the
                force.

        Raises:
            PressError: If the file is not a file of presses, or if it has further columns. These columns would be lost
                when the file is written again.
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
            OutputError: If the file cannot be written. The previous file is then kept.
        """
        if len(presses):
            write_presses(self.path, presses)
            return
        with as_output_errors(self.path):
            self.path.unlink(missing_ok=True)


@contextmanager
def open_press_file(path: Path, sensor: Sensor, probe: Probe, *, fresh: bool = False) -> Iterator[PressFile]:
    """Open a file of presses for one session, and lock the session during a `with` block (context manager).

    A hidden file beside the file of presses contains the sensor and the probe. This hidden file is locked. After the
    block, the hidden file is removed if there is no file of presses.

    Args:
        path: The file, in the format CSV, or Parquet if its name ends in `.parquet`. It may contain the presses of an
            earlier session.
        sensor: Sensor on which the presses are made.
        probe: Probe with which the presses are made.
        fresh: Whether to delete the presses of an earlier session.

    Raises:
        PressError: If the presses in the file were made on another sensor or with another probe.
        OutputExists: If another process writes presses to this file.
        OutputError: If the file cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: expected a file for the presses, got a folder or a device; choose another output")
    content = json.dumps({"sensor": sensor_to_dict(sensor), "probe": probe.notation}).encode()
    # Decoded again, so that the values have the types of JSON, as those in the file of an earlier session
    sensor_and_probe = json.loads(content)
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
                    _check_same_sensor_and_probe(path, session_path, sensor_and_probe)
                else:
                    # The hidden file may contain another sensor or probe. It is written in place, because a new file
                    # that replaces it would not be locked.
                    session_path.write_bytes(content)
                yield PressFile(path, sensor)
            finally:
                if not path.exists():
                    session_path.unlink(missing_ok=True)


def _check_same_sensor_and_probe(path: Path, session_path: Path, sensor_and_probe: dict[str, Any]) -> None:
    """Raise PressError if earlier presses were made on another sensor or with another probe.

    Args:
        path: The file of presses, for the error message.
        session_path: The hidden file with the sensor and the probe of the earlier presses.
        sensor_and_probe: The present sensor and probe, in the form of the hidden file.
    """
    earlier = read_json(session_path, "the sensor and the probe of a press session", PressError, dict[str, Any])
    differing_names = [name for name, value in sensor_and_probe.items() if earlier.get(name) != value]
    if differing_names:
        raise PressError(
            f"{path}: expected presses of this sensor and probe, got presses of another "
            f"{' and another '.join(differing_names)}; continue with the same sensor and probe, choose another "
            "output, or delete the presses with --fresh"
        )
