"""A ROS 2 node that publishes the contacts of a film. The node has the parameters listed in `DEFAULT_PARAMETERS`."""

from collections import Counter

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String

from isocharge.serve import Port, Predictor, load_device, stream
from isocharge.serve.flags import INVALID, MEANINGS
from isocharge.serve.outputs.ros_messages import (
    DEFLECTION_STD_m,
    ROTATION_VARIANCE_rad2,
    ros_time_ns,
    with_tracked_contact,
)

DEFAULT_PARAMETERS = {"model": "three-25um-biaxial", "port": "/dev/ttyACM0", "device": "", "wait_s": 60.0}
"""Parameters of the node with their default values."""

NANOSECONDS_PER_SECOND = 10**9

DIAGNOSTIC_INTERVAL_s = 1.0
"""Smallest time between two messages of `/diagnostics`, s."""

X_WITH_Y = 1
Y_WITH_X = 6
DIAGONAL = slice(0, 36, 7)
"""Positions in a covariance matrix of x, y, z and three rotations, which is a list of 36 numbers, row by row."""


class TouchNode(Node):
    """Node that publishes the wrench and the pose of each contact, the flags, and diagnostics."""

    def __init__(self):
        """Create one publisher for each topic."""
        super().__init__("isocharge")
        self.wrench_publisher = self.create_publisher(WrenchStamped, "/isocharge/wrench", qos_profile_sensor_data)
        self.pose_publisher = self.create_publisher(
            PoseWithCovarianceStamped, "/isocharge/pose", qos_profile_sensor_data
        )
        self.flags_publisher = self.create_publisher(String, "/isocharge/flags", qos_profile_sensor_data)
        self.diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.flag_counts = Counter()
        self.n_records = 0
        self.latest_diagnostic_s = 0.0  # time of the record with which the latest diagnostic was published, s

    def publish(self, record):
        """Publish the flags and the wrench of a prediction record and, if something touches the film, the pose.

        A diagnostic is also published, but at most once in `DIAGNOSTIC_INTERVAL_s`. It counts the records and the flags
        since the previous diagnostic.
        """
        flags = String()
        flags.data = ",".join(record.flags)
        self.flags_publisher.publish(flags)
        self.flag_counts.update(record.flags)
        self.n_records += 1
        # The difference is negative if the clock of the computer was set back.
        if abs(record.timestamp - self.latest_diagnostic_s) >= DIAGNOSTIC_INTERVAL_s:
            self.publish_diagnostic(record)
            self.latest_diagnostic_s = record.timestamp
            self.flag_counts.clear()
            self.n_records = 0
        if record.force_N is None:  # the force is unknown, for example because the board has sent a value that is NaN
            return
        # A tracked contact replaces the contact of the frame. The record itself still gives the header of the messages.
        record_values = with_tracked_contact(record.json_values)
        self.publish_wrench(record_values, record)
        if record.contact:
            self.publish_pose(record_values, record)

    def publish_wrench(self, record_values, record):
        """Publish the load of the probe on the film as a wrench, in N and N m.

        If a probe presses with the force F at (x, y), the wrench has the force (0, 0, -F) and the torque (-y F, x F, 0)
        about the origin.

        Args:
            record_values: Values of the record by name, in which a tracked contact replaces the contact of the frame.
            record: The record, which has the time and the coordinate frame.
        """
        force_N = record_values["force_N"]
        # Without a contact, there is no position. The force is then 0, so any position gives the torque 0.
        x_m = 1e-3 * (record_values["x_mm"] or 0.0)
        y_m = 1e-3 * (record_values["y_mm"] or 0.0)

        message = self.with_header(WrenchStamped(), record)
        message.wrench.force.z = -force_N
        message.wrench.torque.x = -y_m * force_N
        message.wrench.torque.y = x_m * force_N
        self.wrench_publisher.publish(message)

    def publish_pose(self, record_values, record):
        """Publish the position of the contact and its covariance as a pose, in m, m^2 and rad^2.

        Args:
            record_values: Values of the record by name, in which a tracked contact replaces the contact of the frame.
            record: The record, which has the time and the coordinate frame.
        """
        x_std_m = 1e-3 * record_values["x_std_mm"]
        y_std_m = 1e-3 * record_values["y_std_mm"]
        xy_correlation = record.xy_correlation or 0.0  # some models compute no correlation
        xy_covariance = x_std_m * y_std_m * xy_correlation
        rotation_variances = [ROTATION_VARIANCE_rad2] * 3

        message = self.with_header(PoseWithCovarianceStamped(), record)
        message.pose.pose.position.x = 1e-3 * record_values["x_mm"]
        message.pose.pose.position.y = 1e-3 * record_values["y_mm"]
        # The covariance of x, y, z and three rotations is a list of 36 numbers, row by row.
        message.pose.covariance[DIAGONAL] = [x_std_m**2, y_std_m**2, DEFLECTION_STD_m**2, *rotation_variances]
        message.pose.covariance[X_WITH_Y] = xy_covariance
        message.pose.covariance[Y_WITH_X] = xy_covariance
        self.pose_publisher.publish(message)

    def publish_diagnostic(self, record):
        """Publish the meanings of the flags since the last diagnostic, and how many records had each flag.

        The level is OK without flags, ERROR if a record had the flag `invalid`, and WARN with other flags. The caller
        sets the counts back to zero afterwards.

        Args:
            record: The latest record.
        """
        status = DiagnosticStatus()
        status.name = "isocharge: film"
        status.hardware_id = record.frame_id
        status.level = DiagnosticStatus.WARN if self.flag_counts else DiagnosticStatus.OK
        if INVALID in self.flag_counts:
            status.level = DiagnosticStatus.ERROR
        status.message = "; ".join(MEANINGS[flag] for flag in self.flag_counts) or "no flags"

        values = {"model": record.model, "records": self.n_records, "misfit": record.misfit}
        values["latency_us"] = record.latency_us
        for name, value in {**values, **self.flag_counts}.items():
            pair = KeyValue()
            pair.key = name
            pair.value = str(value)
            status.values.append(pair)
        message = self.with_header(DiagnosticArray(), record)
        message.status.append(status)
        self.diagnostics_publisher.publish(message)

    def with_header(self, message, record):
        """Copy the coordinate frame and the time of a record into the header of a message, and return the message."""
        time_ns = ros_time_ns({"timestamp": record.timestamp})  # the function expects a record as a dictionary
        seconds, nanoseconds = divmod(time_ns, NANOSECONDS_PER_SECOND)
        message.header.frame_id = record.frame_id
        message.header.stamp.sec = seconds
        message.header.stamp.nanosec = nanoseconds
        return message


def main():
    """Read the port of the board, compute the contacts, and publish each record until the node is stopped."""
    rclpy.init()
    node = TouchNode()
    parameters = {}
    for name, default in DEFAULT_PARAMETERS.items():
        parameters[name] = node.declare_parameter(name, default).value

    try:
        device = load_device(parameters["device"] or None)  # an empty name means the default device
        predictor = Predictor(parameters["model"])
        with Port(parameters["port"], wait=parameters["wait_s"], reconnect=True, request=device.request) as port:
            for record in stream(port, predictor, device):
                node.publish(record)
                if not rclpy.ok():  # ROS 2 has stopped the node
                    break
    except KeyboardInterrupt:  # Ctrl-C is the usual way to stop the node
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
