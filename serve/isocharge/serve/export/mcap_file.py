"""Prediction records as an MCAP file: the record itself, the wrench of the press and its pose.

| topic | message | written for |
|---|---|---|
| `/isocharge/record` | the record, JSON with its schema, or a `std_msgs/msg/String` of that JSON | every record |
| `/isocharge/wrench` | `geometry_msgs/msg/WrenchStamped` | every record with a force, 0 N out of contact included |
| `/isocharge/pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` | every record with a position |

Log time and publish time are the record's `timestamp`. The file grows by whole chunks, one a second or sooner. A
process that is killed leaves a file without its index, from which `mcap recover` and viewers take all but the last
second.
"""

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Self

from isocharge.common.errors import InputError
from isocharge.common.extras import require
from isocharge.common.files import WholeWrites, refusals_explained
from isocharge.serve.export.record_messages import (
    NAME,
    POSE,
    POSE_DEFINITION,
    STRING,
    STRING_DEFINITION,
    WRENCH,
    WRENCH_DEFINITION,
    RecordEncoding,
    pose_stamped,
    record_schema,
    string_message,
    time_of,
    wrench_stamped,
)

with require("record"):
    from mcap.writer import Writer

RECORD_TOPIC, WRENCH_TOPIC, POSE_TOPIC = "/isocharge/record", "/isocharge/wrench", "/isocharge/pose"

FLUSH_S = 1.0
"""Longest time for which records wait in memory, s; more are lost if the process is killed."""

LARGEST_COUNT = 0xFFFFFFFF
"""Largest sequence number of a message, after which it begins again at 0."""

log = logging.getLogger(__name__)


class McapFile:
    """Writes an MCAP file; a context manager.

    Attributes:
        path: The file.
        records: Number of records written.
        failed: Whether `write_live` has given up. What was written before is whole, but has no index.
    """

    def __init__(
        self,
        path: Path,
        electrodes: tuple[str, ...],
        encoding: RecordEncoding = RecordEncoding.json,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Describe a file; it is created on entering the context.

        Args:
            path: The file; it must not exist.
            electrodes: Names of the electrodes, for the schema.
            encoding: How records are written: JSON with a schema for viewers, or as a ROS 2 message, for tools that
                refuse a file with any other (`ros2 bag`, rosbags).
            now: A clock that never goes back, s.
        """
        self.path, self.records, self.failed = path, 0, False
        self._electrodes, self._encoding, self._now = electrodes, encoding, now
        self._flushed = 0.0
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            OutputExists: If it is already there.
            OutputError: If it cannot be created.
        """
        self._file = WholeWrites(self.path)
        self._writer = Writer(self._file)  # type: ignore[arg-type]  # all it uses is write, tell and flush
        self._flushed = self._now()
        with refusals_explained(self.path):
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
            OSError: If the disk is full, or gone.
        """
        with self._lock, closing(self._file):
            if not self.failed:
                self._writer.finish()  # type: ignore[no-untyped-call]

    def write(self, line: str) -> None:
        """Write a record.

        Args:
            line: The record's line of JSON.

        Raises:
            InputError: If its time is none that ROS 2 has.
            OSError: If the disk is full, or gone.
        """
        record = json.loads(line)
        time_ns = time_of(record)
        is_json = self._encoding is RecordEncoding.json
        messages = {
            RECORD_TOPIC: line.encode() if is_json else string_message(line),
            WRENCH_TOPIC: wrench_stamped(record, time_ns),
            POSE_TOPIC: pose_stamped(record, time_ns),
        }
        with self._lock:
            self._add(messages, time_ns)

    def write_live(self, line: str) -> None:
        """As `write`, but an error ends the file with a message in the log, and not the stream."""
        if self.failed:
            return
        try:
            self.write(line)
        except (InputError, OSError) as error:
            self.give_up(error)

    def give_up(self, error: InputError | OSError) -> None:
        """Write no more, and say in the log why."""
        self.failed = True
        reason = error.strerror if isinstance(error, OSError) else error
        log.error("%s: stopped (%s); what was written until now is whole, but without an index", self.path, reason)

    def _add(self, messages: dict[str, bytes | None], time_ns: int) -> None:
        for topic, data in messages.items():
            if data is not None:
                self._writer.add_message(
                    self._channels[topic], time_ns, data, publish_time=time_ns, sequence=self.records & LARGEST_COUNT
                )
        self.records += 1
        if self._now() - self._flushed >= FLUSH_S:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._flushed = self._now()

    def _record_channel(self) -> int:
        if self._encoding is RecordEncoding.ros2:
            return self._ros_channel(RECORD_TOPIC, STRING, STRING_DEFINITION)
        schema = json.dumps(record_schema(self._electrodes)).encode()
        return self._writer.register_channel(
            RECORD_TOPIC, "json", self._writer.register_schema(NAME, "jsonschema", schema)
        )

    def _ros_channel(self, topic: str, kind: str, definition: str) -> int:
        schema = self._writer.register_schema(kind, "ros2msg", definition.encode())
        return self._writer.register_channel(topic, "cdr", schema)
