"""MCAP files that contain prediction records, and the wrench and the pose of each press.

| topic | message | written for |
|---|---|---|
| `/isocharge/record` | the record, as JSON with its schema or as a `std_msgs/msg/String` of that JSON | every record |
| `/isocharge/wrench` | `geometry_msgs/msg/WrenchStamped` | every record with a force, including 0 N out of contact |
| `/isocharge/pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` | every record with a position |

The log time and the publish time of a message are the `timestamp` of the record. At least once per second, a complete
chunk of messages is written to the file. If the process is killed, the file has no index. Viewers and the command `mcap
recover` can nevertheless read all records except the records of the last second.
"""

import json
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Self

from isocharge.common.extras import require
from isocharge.common.files import AtomicWriter, as_output_errors
from isocharge.serve.export.record_messages import (
    POSE,
    POSE_DEFINITION,
    STRING,
    STRING_DEFINITION,
    WRENCH,
    WRENCH_DEFINITION,
    RecordEncoding,
    pose_stamped,
    ros_time_ns,
    string_message,
    wrench_stamped,
)
from isocharge.serve.record.record import PredictionRecord
from isocharge.serve.record.schema import SCHEMA_NAME, record_schema

with require("record"):
    from mcap.writer import Writer

RECORD_TOPIC = "/isocharge/record"
WRENCH_TOPIC = "/isocharge/wrench"
POSE_TOPIC = "/isocharge/pose"

FLUSH_INTERVAL_S = 1.0
"""Longest time for which records wait in memory, s. These records are lost if the process is killed."""

MAX_SEQUENCE_NUMBER = 0xFFFFFFFF
"""Largest sequence number of a message. The next number is 0."""


class McapFile:
    """Context manager that writes an MCAP file.

    Attributes:
        path: The file.
        records: Number of records written.
        is_abandoned: Whether the file is closed without an index. Set this attribute to True after an error of `write`.
    """

    def __init__(
        self,
        path: Path,
        electrodes: tuple[str, ...],
        encoding: RecordEncoding = RecordEncoding.json,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Store the settings of the file. The file is created when the context is entered.

        Args:
            path: The file, which must not exist.
            electrodes: Names of the electrodes, for the schema.
            encoding: Encoding of the records: JSON with a schema for viewers, or ROS 2 messages for tools that refuse
                all other messages (`ros2 bag`, rosbags).
            now: Function that returns the time of a monotonic clock, s.
        """
        self.path = path
        self.records = 0
        self.is_abandoned = False
        self._electrodes = electrodes
        self._encoding = encoding
        self._now = now
        self._flush_time_s = 0.0  # time of the latest flush on the clock `now`
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        """Create the file, write its header, and register one channel for each of the three topics.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        self._file = AtomicWriter(self.path)
        self._writer = Writer(self._file)  # type: ignore[arg-type]  # uses only write, tell and flush
        self._flush_time_s = self._now()
        with as_output_errors(self.path):
            self._writer.start(profile="ros2", library="isocharge")
            self._channels = {
                RECORD_TOPIC: self._record_channel(),
                WRENCH_TOPIC: self._ros_channel(WRENCH_TOPIC, WRENCH, WRENCH_DEFINITION),
                POSE_TOPIC: self._ros_channel(POSE_TOPIC, POSE, POSE_DEFINITION),
            }
        return self

    def __exit__(self, *_: object) -> None:
        """Write the index and close the file.

        Raises:
            OSError: If the disk is full or was removed.
        """
        with self._lock, closing(self._file):
            if not self.is_abandoned:
                self._writer.finish()  # type: ignore[no-untyped-call]

    def write(self, record: PredictionRecord) -> None:
        """Write a record, its wrench if the force is known, and its pose if something touches the film.

        Raises:
            InputError: If a time stamp of ROS 2 cannot represent the time of the record.
            OSError: If the disk is full or was removed.
        """
        values = record.json_values
        time_ns = ros_time_ns(values)
        json_text = record.to_json()
        is_json = self._encoding is RecordEncoding.json
        record_message = json_text.encode() if is_json else string_message(json_text)
        messages = {
            RECORD_TOPIC: record_message,
            WRENCH_TOPIC: wrench_stamped(values, time_ns),
            POSE_TOPIC: pose_stamped(values, time_ns),
        }
        with self._lock:
            self._add_messages(messages, time_ns)

    def _add_messages(self, messages: dict[str, bytes | None], time_ns: int) -> None:
        """Add the messages of one record. Flush the writer if `FLUSH_INTERVAL_S` have passed since the last flush.

        The caller must hold the lock of the file.

        Args:
            messages: Message for each topic; None if the record has no message for the topic.
            time_ns: Time of the record, ns.
        """
        sequence = self.records & MAX_SEQUENCE_NUMBER  # the number has 32 bits and wraps to 0
        for topic, message in messages.items():
            if message is not None:
                channel = self._channels[topic]
                self._writer.add_message(channel, time_ns, message, publish_time=time_ns, sequence=sequence)
        self.records += 1
        if self._now() - self._flush_time_s >= FLUSH_INTERVAL_S:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._flush_time_s = self._now()

    def _record_channel(self) -> int:
        """Register the channel of the records in the file, and return its identifier.

        The messages of this channel are either ROS 2 texts, or JSON with a JSON schema.
        """
        if self._encoding is RecordEncoding.ros2:
            return self._ros_channel(RECORD_TOPIC, STRING, STRING_DEFINITION)

        schema_text = json.dumps(record_schema(self._electrodes)).encode()
        schema_id = self._writer.register_schema(SCHEMA_NAME, "jsonschema", schema_text)
        return self._writer.register_channel(RECORD_TOPIC, "json", schema_id)

    def _ros_channel(self, topic: str, message_type: str, definition: str) -> int:
        """Register a channel of ROS 2 messages in the file, and return its identifier.

        Args:
            topic: Topic of the messages.
            message_type: Name of the message type, such as "std_msgs/msg/String".
            definition: Definition of the message type in the notation of ROS 2.
        """
        schema_id = self._writer.register_schema(message_type, "ros2msg", definition.encode())
        return self._writer.register_channel(topic, "cdr", schema_id)
