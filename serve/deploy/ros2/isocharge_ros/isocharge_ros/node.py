"""A ROS 2 node that publishes the contacts of a film. The parameters of the node are model, port, device and wait_s."""

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from isocharge.serve import Port, Predictor, load_device, stream
from isocharge.serve.export.record_messages import DEFLECTION_STD_m, ROTATION_VARIANCE_rad2, contact_of, time_of

DEFAULT_PARAMETERS = {"model": "three-25um-biaxial", "port": "/dev/ttyACM0", "device": "", "wait_s": 60.0}
"""Parameters of the node with their default values."""

NANOSECONDS_PER_SECOND = 10**9

X_WITH_Y = 1
Y_WITH_X = 6
DIAGONAL = slice(0, 36, 7)
"""Positions in a covariance of 6 rows and 6 columns (x, y, z and three rotations), which is stored row by row."""


class TouchNode(Node):
    """Node that publishes the wrench and the pose of each contact."""

    def __init__(self):
        """Create the publishers."""
        super().__init__("isocharge")
        self.wrench_publisher = self.create_publisher(WrenchStamped, "/isocharge/wrench", qos_profile_sensor_data)
        self.pose_publisher = self.create_publisher(
            PoseWithCovarianceStamped, "/isocharge/pose", qos_profile_sensor_data
        )

    def publish(self, record):
        """Publish the wrench of a record and, if something touches the film, the pose of the contact."""
        if record.force_N is None:  # the board has sent a value that is no number
            return
        contact = contact_of(record.json_values)
        self.publish_wrench(contact, record)
        if record.contact:
            self.publish_pose(contact, record)

    def publish_wrench(self, contact, record):
        """Publish the load of the probe on the film, N and N m about the origin. The force acts along -z."""
        force_N = contact["force_N"]
        x_m = 1e-3 * (contact["x_mm"] or 0.0)
        y_m = 1e-3 * (contact["y_mm"] or 0.0)
        message = self.with_header(WrenchStamped(), record)
        message.wrench.force.z = -force_N
        message.wrench.torque.x = -y_m * force_N
        message.wrench.torque.y = x_m * force_N
        self.wrench_publisher.publish(message)

    def publish_pose(self, contact, record):
        """Publish the position of the contact with its covariance, m and m^2."""
        x_std_m = 1e-3 * contact["x_std_mm"]
        y_std_m = 1e-3 * contact["y_std_mm"]
        rotation_variances = [ROTATION_VARIANCE_rad2] * 3
        xy_covariance = x_std_m * y_std_m * (record.xy_correlation or 0.0)
        message = self.with_header(PoseWithCovarianceStamped(), record)
        message.pose.pose.position.x = 1e-3 * contact["x_mm"]
        message.pose.pose.position.y = 1e-3 * contact["y_mm"]
        message.pose.covariance[DIAGONAL] = [x_std_m**2, y_std_m**2, DEFLECTION_STD_m**2, *rotation_variances]
        message.pose.covariance[X_WITH_Y] = xy_covariance
        message.pose.covariance[Y_WITH_X] = xy_covariance
        self.pose_publisher.publish(message)

    def with_header(self, message, record):
        """Set the frame and the time of a message to those of a record, and return the message."""
        seconds, nanoseconds = divmod(time_of({"timestamp": record.timestamp}), NANOSECONDS_PER_SECOND)
        message.header.frame_id = record.frame_id
        message.header.stamp.sec = seconds
        message.header.stamp.nanosec = nanoseconds
        return message


def main():
    """Read the port, and publish each record until the node is stopped."""
    rclpy.init()
    node = TouchNode()
    parameters = {name: node.declare_parameter(name, default).value for name, default in DEFAULT_PARAMETERS.items()}
    try:
        device = load_device(parameters["device"] or None)
        predictor = Predictor(parameters["model"])
        with Port(parameters["port"], wait=parameters["wait_s"], reconnect=True, request=device.request) as port:
            for record in stream(port, predictor, device):
                node.publish(record)
                if not rclpy.ok():  # another process has stopped the node
                    break
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
