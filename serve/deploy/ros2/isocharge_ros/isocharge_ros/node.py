"""A ROS 2 node that publishes the contacts of a film. Its parameters: model, port, device, wait_s."""

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from isocharge.serve import Port, Predictor, load_device, stream
from isocharge.serve.export.record_messages import DEFLECTION_STD_m, ROTATION_VARIANCE_rad2, contact_of, time_of


class TouchNode(Node):
    def __init__(self):
        super().__init__("isocharge")
        self.wrench = self.create_publisher(WrenchStamped, "/isocharge/wrench", qos_profile_sensor_data)
        self.pose = self.create_publisher(PoseWithCovarianceStamped, "/isocharge/pose", qos_profile_sensor_data)

    def stamped(self, message, record):
        message.header.frame_id = record.frame_id
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_of({"timestamp": record.timestamp}), 10**9)
        return message

    def publish(self, record):
        if record.force_N is None:  # the board sent something that is no number
            return
        touch = contact_of(record.json_values)
        force, x, y = touch["force_N"], 1e-3 * (touch["x_mm"] or 0.0), 1e-3 * (touch["y_mm"] or 0.0)
        message = self.stamped(WrenchStamped(), record)
        message.wrench.force.z = -force
        message.wrench.torque.x, message.wrench.torque.y = -y * force, x * force
        self.wrench.publish(message)
        if record.contact:
            message = self.stamped(PoseWithCovarianceStamped(), record)
            message.pose.pose.position.x, message.pose.pose.position.y = x, y
            x_std, y_std = 1e-3 * touch["x_std_mm"], 1e-3 * touch["y_std_mm"]
            message.pose.covariance[::7] = [x_std**2, y_std**2, DEFLECTION_STD_m**2, *[ROTATION_VARIANCE_rad2] * 3]
            message.pose.covariance[1] = message.pose.covariance[6] = x_std * y_std * (record.xy_correlation or 0.0)
            self.pose.publish(message)


def main():
    rclpy.init()
    node = TouchNode()
    model, url, file, wait_s = (
        node.declare_parameter(name, value).value
        for name, value in (("model", "three-25um-biaxial"), ("port", "/dev/ttyACM0"), ("device", ""), ("wait_s", 60.0))
    )
    try:
        device = load_device(file or None)
        with Port(url, wait=wait_s, reconnect=True, request=device.request) as port:
            for record in stream(port, Predictor(model), device):
                node.publish(record)
                if not rclpy.ok():  # stopped from outside
                    break
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
