"""Models that compute contacts from charges, and streams that convert the bytes of a board to prediction records.

    >>> from isocharge.serve import Predictor
    >>> touch = Predictor("three-25um-biaxial")
    >>> contact = touch.predict([850.0, 840.0, 846.0])  # pC on A, B, C

The packages are arranged in the order in which they process a frame. `serve/README.md` lists them.
"""

from typing import TYPE_CHECKING

from isocharge.common.errors import lazy_names

if TYPE_CHECKING:
    from isocharge.serve.examination.port_check import Examination, examine
    from isocharge.serve.frames.binary import BinaryParser, encode_frame
    from isocharge.serve.frames.formats import AutoParser
    from isocharge.serve.frames.frame import Frame
    from isocharge.serve.frames.text import encode_text
    from isocharge.serve.live.device import device_from_table, load_device
    from isocharge.serve.live.steady_press import PressWatch
    from isocharge.serve.live.stream import ReadingStream, TouchStream, stream
    from isocharge.serve.model.contact import Contact, Contacts, Validity
    from isocharge.serve.model.metadata import ModelMetadata
    from isocharge.serve.model.model_folder import (
        Model,
        check_golden,
        find_labelled_model,
        find_model,
        load_checked_model,
        load_model,
        write_model,
    )
    from isocharge.serve.model.predictor import Predictor
    from isocharge.serve.network.protocol.handler import asgi_app
    from isocharge.serve.port.file_source import Chunk
    from isocharge.serve.port.recording import Recorder, Recording
    from isocharge.serve.port.source import Port, open_source
    from isocharge.serve.prediction.press_check import PressCheck, check_presses
    from isocharge.serve.prediction.table import read_charges, table_records, write_contacts
    from isocharge.serve.presses.measured_presses import MeasuredPresses, read_presses, write_presses
    from isocharge.serve.record.record import PredictionRecord
    from isocharge.serve.signal_chain.stage import Device
    from isocharge.serve.virtual_sensor.script import Faults, Script, wander
    from isocharge.serve.virtual_sensor.sensor import VirtualSensor
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__ = lazy_names(__name__)

__all__ = [
    "AutoParser",
    "BinaryParser",
    "Chunk",
    "Contact",
    "Contacts",
    "Device",
    "Examination",
    "Faults",
    "Frame",
    "MeasuredPresses",
    "Model",
    "ModelMetadata",
    "Port",
    "PredictionRecord",
    "Predictor",
    "PressCheck",
    "PressWatch",
    "ReadingStream",
    "Recorder",
    "Recording",
    "Script",
    "TouchStream",
    "Validity",
    "VirtualSensor",
    "asgi_app",
    "check_golden",
    "check_presses",
    "device_from_table",
    "encode_frame",
    "encode_text",
    "examine",
    "find_labelled_model",
    "find_model",
    "load_checked_model",
    "load_device",
    "load_model",
    "open_source",
    "read_charges",
    "read_presses",
    "stream",
    "table_records",
    "wander",
    "write_contacts",
    "write_model",
    "write_presses",
]

__version__: str


def __dir__() -> list[str]:
    """Return the public names, so that tab completion suggests no other names."""
    return list(__all__)
