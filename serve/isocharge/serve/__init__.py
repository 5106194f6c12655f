"""From charges to contacts: models, the predictor, and the live path from a port to prediction records.

    >>> from isocharge.serve import Predictor
    >>> touch = Predictor("three-25um-biaxial")
    >>> contact = touch.predict([850.0, 840.0, 846.0])  # pC on A, B, C

`serve/README.md` says what is in which module.
"""

from isocharge.serve.binary import BinaryParser, encode_frame
from isocharge.serve.chain import Chain
from isocharge.serve.described import DescribedParser, FrameLayout, frame_layout
from isocharge.serve.device import Device, device_from_table, load_device
from isocharge.serve.device_clock import DeviceClock
from isocharge.serve.doctor import Examination, examine
from isocharge.serve.domain import Domain
from isocharge.serve.faults import Faults
from isocharge.serve.frames import Frame, FrameCounts, Parser, SequenceGaps
from isocharge.serve.hum import HumRule
from isocharge.serve.leak import LeakRule
from isocharge.serve.metadata import ModelMetadata
from isocharge.serve.model import Model, check_golden, load_model, write_model
from isocharge.serve.outputs import UdpSink, csv_header, csv_line
from isocharge.serve.port import Chunk, Port
from isocharge.serve.predictor import Contact, Contacts, Predictor
from isocharge.serve.recognise import AutoParser
from isocharge.serve.record import PredictionRecord
from isocharge.serve.recording import RecordedClock, Recorder, Recording
from isocharge.serve.repository import find_model
from isocharge.serve.script import Script, read_script, wander
from isocharge.serve.source import open_source
from isocharge.serve.stream import Policy, TouchStream, stream
from isocharge.serve.table import read_charges, table_records, write_contacts
from isocharge.serve.tare import Tare, TareRule
from isocharge.serve.text import TextParser, encode_text
from isocharge.serve.touching import TouchRule
from isocharge.serve.virtual import Truth, VirtualSensor

__all__ = [
    "AutoParser",
    "BinaryParser",
    "Chain",
    "Chunk",
    "Contact",
    "Contacts",
    "DescribedParser",
    "Device",
    "DeviceClock",
    "Domain",
    "Examination",
    "Faults",
    "Frame",
    "FrameCounts",
    "FrameLayout",
    "HumRule",
    "LeakRule",
    "Model",
    "ModelMetadata",
    "Parser",
    "Policy",
    "Port",
    "PredictionRecord",
    "Predictor",
    "RecordedClock",
    "Recorder",
    "Recording",
    "Script",
    "SequenceGaps",
    "Tare",
    "TareRule",
    "TextParser",
    "TouchRule",
    "TouchStream",
    "Truth",
    "UdpSink",
    "VirtualSensor",
    "check_golden",
    "csv_header",
    "csv_line",
    "device_from_table",
    "encode_frame",
    "encode_text",
    "examine",
    "find_model",
    "frame_layout",
    "load_device",
    "load_model",
    "open_source",
    "read_charges",
    "read_script",
    "stream",
    "table_records",
    "wander",
    "write_contacts",
    "write_model",
]
