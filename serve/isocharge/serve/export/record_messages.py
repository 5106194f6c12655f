"""A prediction record as messages for ROS 2, encoded in CDR: the wrench of the press, its pose, and the record as text.

The frame is `frame_id`, the name of the sensor. Origin, x and y are those of README.md, Coordinates. ROS requires
right-handed frames, so z points towards the probe, against the push. The wrench is the load of the probe on the film: a
press of F at (x, y) has the force (0, 0, -F) and the torque (-y F, x F, 0) about the origin. The pose is the point of
contact in the plane of the unloaded film, without rotation, with the model's standard deviations.

Where contacts are followed, wrench and pose are those of the contact by all frames up to now, as on the live page; what
the frame alone says is in the record.

ROS messages are a header and doubles. They are packed here because `mcap-ros2-support` offers its encoder only inside a
writer of its own, which writes no JSON, and takes 15 times as long; tests read them with it and with rosbags.
"""

import math
import struct
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from isocharge.common.errors import InputError

DEFLECTION_STD = 5e-3
"""Standard deviation of z, m: the model does not say how far the film gives way, a few mm under some newtons."""

TURN_VARIANCE = math.pi**2 / 3.0
"""Variance of every rotation, rad^2: that of an angle of which nothing is known."""

LATEST_S = 1 << 31
"""End of the times that a ROS 2 stamp holds, unix seconds: the year 2038."""

ENCAPSULATION = b"\x00\x01\x00\x00"
"""First bytes of a CDR message: little endian, no options."""

_SEPARATOR = "=" * 80 + "\n"
_HEADER = f"""{_SEPARATOR}MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

WRENCH = "geometry_msgs/msg/WrenchStamped"
WRENCH_DEFINITION = f"""std_msgs/Header header
Wrench wrench
{_SEPARATOR}MSG: geometry_msgs/Wrench
Vector3 force
Vector3 torque
{_SEPARATOR}MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_HEADER}"""

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_DEFINITION = f"""std_msgs/Header header
PoseWithCovariance pose
{_SEPARATOR}MSG: geometry_msgs/PoseWithCovariance
Pose pose
float64[36] covariance
{_SEPARATOR}MSG: geometry_msgs/Pose
Point position
Quaternion orientation
{_SEPARATOR}MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_SEPARATOR}MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
{_HEADER}"""

STRING = "std_msgs/msg/String"
STRING_DEFINITION = "string data\n"


def time_of(record: Mapping[str, Any]) -> int:
    """The record's `timestamp` in nanoseconds, exact to the microsecond that its six decimals give.

    Raises:
        InputError: If ROS 2 has no stamp for it.
    """
    seconds: float | None = record["timestamp"]
    if seconds is None or not 0.0 <= seconds < LATEST_S:
        raise InputError(
            f"timestamp {seconds!r}: expected unix seconds from 1970 to 2038, as ROS 2 holds them; set the clock of "
            "the computer that reads the sensor"
        )
    return round(seconds * 1e6) * 1000


def contact_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """The record with the contact that is followed in the place of the frame's, where the frame says anything."""
    tracked = record.get("tracked")
    return record if tracked is None or record["force_N"] is None else {**record, **tracked}


def wrench_stamped(record: Mapping[str, Any], time_ns: int) -> bytes | None:
    """The record as WrenchStamped, N and N m; zeros out of contact, None where the force is unknown."""
    record = contact_of(record)
    force = record["force_N"]
    if force is None:
        return None
    x, y = 1e-3 * (record["x_mm"] or 0.0), 1e-3 * (record["y_mm"] or 0.0)
    return _stamped(record["frame_id"], time_ns, (0.0, 0.0, 0.0 - force, 0.0 - y * force, x * force, 0.0))


def pose_stamped(record: Mapping[str, Any], time_ns: int) -> bytes | None:
    """The record as PoseWithCovarianceStamped, m, m^2 and rad^2; None where nothing touches."""
    record = contact_of(record)
    x, y, x_std, y_std = (record[name] for name in ("x_mm", "y_mm", "x_std_mm", "y_std_mm"))
    xy_correlation = record.get("xy_correlation") or 0.0  # a record of an earlier version has none
    if None in (x, y, x_std, y_std):
        return None
    covariance = [0.0] * 36  # rows and columns x, y, z, and the rotations about them
    covariance[::7] = (1e-3 * x_std) ** 2, (1e-3 * y_std) ** 2, DEFLECTION_STD**2, *(TURN_VARIANCE,) * 3
    covariance[1] = covariance[6] = 1e-6 * x_std * y_std * xy_correlation
    pose = (1e-3 * x, 1e-3 * y, 0.0, 0.0, 0.0, 0.0, 1.0)
    return _stamped(record["frame_id"], time_ns, (*pose, *covariance))


def string_message(text: str) -> bytes:
    """A text as std_msgs/msg/String."""
    return ENCAPSULATION + _string(text)


def _stamped(frame_id: str, time_ns: int, values: tuple[float, ...]) -> bytes:
    """A header and doubles, which begin at a multiple of 8 bytes after the encapsulation."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    header = struct.pack("<iI", seconds, nanoseconds) + _string(frame_id)
    padding = bytes(-len(header) % 8)
    return b"".join((ENCAPSULATION, header, padding, struct.pack(f"<{len(values)}d", *values)))


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


class RecordEncoding(StrEnum):
    """How an MCAP file holds the records themselves: JSON with this schema, or the same text in ROS 2 messages."""

    json = "json"
    ros2 = "ros2"
