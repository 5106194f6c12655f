"""Conversion of prediction records to ROS 2 messages: the wrench of a press, the pose of a press, and a record as text.

The name of the coordinate frame of the messages is the field `frame_id` of the record. The field `frame_id` is the name
of the sensor, unless the user has given the film another name. The section Coordinates of README.md defines the origin
and the axes x and y of this coordinate frame. ROS requires right-handed coordinate frames. The axis z therefore points
from the film towards the probe, against the direction of the push.

The wrench is the load of the probe on the film. If a probe presses with the force F at (x, y), the wrench has the force
(0, 0, -F) and the torque (-y F, x F, 0) about the origin. The pose is the point of contact in the plane of the unloaded
film. The rotation of the pose is zero. The covariance of the pose is computed from the standard deviations that the
model reports. If contacts are tracked, the wrench and the pose describe the tracked contact, as on the live page. The
record as text also contains the contact that was estimated from the single frame.

The messages are encoded in CDR, the binary format of ROS 2. The messages of the wrench and of the pose consist of a
header and numbers of double precision. This module has its own encoder. The encoder of `mcap-ros2-support` is available
only as a part of a writer that is much slower and cannot write JSON. The tests decode the messages with
`mcap-ros2-support` and with rosbags.
"""

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

DEFLECTION_STD_m = 5e-3
"""Standard deviation of z, m. The model does not estimate the deflection of the film, which is a few millimetres."""

ROTATION_VARIANCE_rad2 = math.pi**2 / 3.0
"""Variance of every rotation, rad^2: the variance of an angle that is uniformly distributed over a full turn."""

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
_WRENCH_DEFINITION = f"""std_msgs/Header header
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
_POSE_DEFINITION = f"""std_msgs/Header header
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
DEFINITIONS = {STRING: "string data\n", WRENCH: _WRENCH_DEFINITION, POSE: _POSE_DEFINITION}
"""Definition of each type of message in the notation of ROS 2, by its name."""


def ros_time_ns(record: Mapping[str, Any]) -> int:
    """Return the `timestamp` of a record as unix time in nanoseconds, rounded to a whole microsecond.

    Args:
        record: Values of the prediction record by name.
    """
    seconds: float = record["timestamp"]
    return round(seconds * 1e6) * 1000


def with_tracked_contact(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values of a record with the tracked contact instead of the contact of the single frame.

    The values are unchanged if the record has no tracked contact, or if the force in the single frame is unknown.

    Args:
        record: Values of the prediction record by name.
    """
    tracked_contact = record.get("tracked")
    if tracked_contact is None or record["force_N"] is None:
        return record
    return {**record, **tracked_contact}


def wrench_stamped(values: Mapping[str, Any], time_ns: int) -> bytes | None:
    """Return the load of the probe on the film as a ROS 2 message WrenchStamped, in N and N m.

    If a probe presses with the force F at (x, y), the message has the force (0, 0, -F) and the torque (-y F, x F, 0)
    about the origin.

    Args:
        values: Values of the record by name, in which a tracked contact replaces the contact of the frame.
        time_ns: Time of the record, ns.

    Returns:
        The message, whose numbers are zero if nothing touches the film; None if the force is unknown.
    """
    force_N = values["force_N"]
    if force_N is None:
        return None
    # Out of contact, there is no position. The force is 0, so any position gives the torque 0.
    x_m = 1e-3 * (values["x_mm"] or 0.0)
    y_m = 1e-3 * (values["y_mm"] or 0.0)
    # Subtracting from 0.0 gives 0.0 where a minus sign would give -0.0.
    force = (0.0, 0.0, 0.0 - force_N)
    torque = (0.0 - y_m * force_N, x_m * force_N, 0.0)
    return _stamped(values["frame_id"], time_ns, (*force, *torque))


def pose_stamped(values: Mapping[str, Any], time_ns: int) -> bytes | None:
    """Return the position of a record as a ROS 2 message PoseWithCovarianceStamped, in m, m^2 and rad^2.

    Args:
        values: Values of the record by name, in which a tracked contact replaces the contact of the frame.
        time_ns: Time of the record, ns.

    Returns:
        The message; None if nothing touches the film, so that the position and its standard deviation are unknown.
    """
    if None in (values["x_mm"], values["x_std_mm"]):
        return None
    position = (1e-3 * values["x_mm"], 1e-3 * values["y_mm"], 0.0)
    no_rotation = (0.0, 0.0, 0.0, 1.0)  # a quaternion (x, y, z, w)
    # The covariance has 6 rows and columns: x, y, z and the rotations about x, y and z. Only x and y are correlated.
    std_m = [1e-3 * values["x_std_mm"], 1e-3 * values["y_std_mm"], DEFLECTION_STD_m]
    covariance = np.diag(np.append(np.square(std_m), [ROTATION_VARIANCE_rad2] * 3))
    covariance[[0, 1], [1, 0]] = std_m[0] * std_m[1] * (values["xy_correlation"] or 0.0)
    # `_stamped` encodes a header and the numbers of the message.
    return _stamped(values["frame_id"], time_ns, (*position, *no_rotation, *covariance.ravel().tolist()))


def string_message(text: str) -> bytes:
    """Encode a text as a ROS 2 message std_msgs/msg/String."""
    return ENCAPSULATION + _string(text)


def _stamped(frame_id: str, time_ns: int, values: tuple[float, ...]) -> bytes:
    """Encode a ROS 2 message that consists of a header and numbers of double precision.

    CDR requires that the numbers begin at a multiple of 8 bytes after the encapsulation. The header is therefore padded
    with zeros.

    Args:
        frame_id: Name of the coordinate frame.
        time_ns: Time of the message, ns.
        values: The numbers in the order of the message type.
    """
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    header = struct.pack("<iI", seconds, nanoseconds) + _string(frame_id)
    padding = bytes(-len(header) % 8)
    return b"".join((ENCAPSULATION, header, padding, struct.pack(f"<{len(values)}d", *values)))


def _string(text: str) -> bytes:
    """Encode a text in CDR: the number of the following bytes, the text in UTF-8, and a zero byte."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data
