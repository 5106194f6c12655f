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
import time
from pathlib import Path

from isocharge.common.errors import require
from isocharge.serve.outputs.output import FileOutput
from isocharge.serve.outputs.ros_messages import (
    DEFINITIONS,
    POSE,
    STRING,
    WRENCH,
    pose_stamped,
    ros_time_ns,
    string_message,
    with_tracked_contact,
    wrench_stamped,
)
from isocharge.serve.record.formats import SCHEMA_NAME, record_schema
from isocharge.serve.record.record import PredictionRecord

with require("record"):
    from mcap.writer import Writer

RECORD_TOPIC = "/isocharge/record"
WRENCH_TOPIC = "/isocharge/wrench"
POSE_TOPIC = "/isocharge/pose"

FLUSH_INTERVAL_S = 1.0
"""Longest time for which records wait in memory, s. The waiting records are lost if the process is killed."""


class McapFile(FileOutput):
    """Output that writes records to a new MCAP file.

    Attributes:
        records: Number of records written.
    """

    def __init__(self, path: Path, electrodes: tuple[str, ...], *, is_ros2: bool, is_live: bool) -> None:
        """Create the file, write its header, and register one channel for each of the three topics.

        Args:
            path: The file, which must not exist.
            electrodes: Names of the electrodes, which the schema of the records contains.
            is_ros2: Whether the records are ROS 2 messages, for tools that refuse all other messages (`ros2 bag`,
                rosbags). Otherwise the records are JSON with a schema for viewers.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OSError: If the file cannot be created.
        """
        super().__init__(path, is_live=is_live)
        self.records = 0
        self._is_ros2 = is_ros2
        self._flush_time_s = time.monotonic()
        self._writer = Writer(self._file)  # type: ignore[arg-type]  # uses only write, tell and flush
        # A channel is declared by its topic, the encoding of its messages, the name of its schema, the notation of the
        # schema, and the schema.
        ros2_records = (RECORD_TOPIC, "cdr", STRING, "ros2msg", DEFINITIONS[STRING])
        json_records = (RECORD_TOPIC, "json", SCHEMA_NAME, "jsonschema", json.dumps(record_schema(electrodes)))
        channels = [
            ros2_records if is_ros2 else json_records,
            (WRENCH_TOPIC, "cdr", WRENCH, "ros2msg", DEFINITIONS[WRENCH]),
            (POSE_TOPIC, "cdr", POSE, "ros2msg", DEFINITIONS[POSE]),
        ]
        self._channels: dict[str, int] = {}  # identifier of the channel of each topic
        self._writer.start(profile="ros2", library="isocharge")
        for topic, encoding, schema_name, schema_encoding, schema in channels:
            schema_id = self._writer.register_schema(schema_name, schema_encoding, schema.encode())
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)

    def write(self, record: PredictionRecord) -> None:
        """Write a record, its wrench if the force is known, and its pose if something touches the film.

        Raises:
            struct.error: If a time stamp of ROS 2 cannot represent the time of the record.
            OSError: If the disk is full or was removed.
        """
        record_values = with_tracked_contact(record.json_values)
        time_ns = ros_time_ns(record_values)
        json_text = record.to_json()
        # The message of a wrench is None if the force is unknown, and that of a pose if nothing touches the film.
        messages = {
            RECORD_TOPIC: string_message(json_text) if self._is_ros2 else json_text.encode(),
            WRENCH_TOPIC: wrench_stamped(record_values, time_ns),
            POSE_TOPIC: pose_stamped(record_values, time_ns),
        }
        sequence = self.records % (1 << 32)  # the number in the file has 32 bits
        for topic, message in messages.items():
            if message is not None:
                channel = self._channels[topic]
                self._writer.add_message(channel, time_ns, message, publish_time=time_ns, sequence=sequence)
        self.records += 1
        if time.monotonic() - self._flush_time_s >= FLUSH_INTERVAL_S:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._flush_time_s = time.monotonic()

    def close(self) -> None:
        """Write the index of the messages, and close the file. In a replay, also rename the file."""
        with self._stack:  # in a replay, the stack removes the file after an error
            self._writer.finish()  # type: ignore[no-untyped-call]
