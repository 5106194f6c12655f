"""Models that compute contacts from charges, and streams that convert the bytes of a board to prediction records.

    >>> from isocharge.serve import Predictor
    >>> touch = Predictor("three-25um-biaxial")
    >>> contact = touch.predict([850.0, 840.0, 846.0])  # pC on A, B, C

The packages are arranged in the order in which they process a frame. `serve/README.md` lists them.
"""

from typing import TYPE_CHECKING

from isocharge.common.errors import lazy_names

if TYPE_CHECKING:  # each `as` marks a public name (PEP 484); isort would split the statements
    # isort: off
    from isocharge.serve.examination.port_check import Examination as Examination, examine as examine
    from isocharge.serve.frames.formats import BinaryParser as BinaryParser, encode_frame as encode_frame
    from isocharge.serve.frames.formats import AutoParser as AutoParser
    from isocharge.serve.frames.frame import Frame as Frame
    from isocharge.serve.frames.text import encode_text as encode_text
    from isocharge.serve.live.device import device_from_table as device_from_table, load_device as load_device
    from isocharge.serve.live.steady_press import PressWatch as PressWatch
    from isocharge.serve.live.stream import ReadingStream as ReadingStream, TouchStream as TouchStream, stream as stream
    from isocharge.serve.model.contact import Contact as Contact, Contacts as Contacts, Validity as Validity
    from isocharge.serve.model.metadata import ModelMetadata as ModelMetadata
    from isocharge.serve.model.model_folder import (
        Model as Model,
        check_golden as check_golden,
        find_labelled_model as find_labelled_model,
        find_model as find_model,
        load_checked_model as load_checked_model,
        load_model as load_model,
        write_model as write_model,
    )
    from isocharge.serve.model.predictor import Predictor as Predictor
    from isocharge.serve.network.protocol.handler import asgi_app as asgi_app
    from isocharge.serve.port.file_source import Chunk as Chunk
    from isocharge.serve.port.recording import Recorder as Recorder, Recording as Recording
    from isocharge.serve.port.source import Port as Port, open_source as open_source
    from isocharge.serve.prediction.press_check import PressCheck as PressCheck, check_presses as check_presses
    from isocharge.serve.prediction.table import (
        read_charges as read_charges,
        table_records as table_records,
        write_contacts as write_contacts,
    )
    from isocharge.serve.presses.measured_presses import (
        MeasuredPresses as MeasuredPresses,
        read_presses as read_presses,
        write_presses as write_presses,
    )
    from isocharge.serve.record.record import PredictionRecord as PredictionRecord
    from isocharge.serve.signal_chain.stage import Device as Device
    from isocharge.serve.virtual_sensor.script import Faults as Faults, Script as Script, wander as wander
    from isocharge.serve.virtual_sensor.sensor import VirtualSensor as VirtualSensor
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__, __dir__, __all__ = lazy_names(__name__, "http")  # only `asgi_app` needs an extra

__version__: str
