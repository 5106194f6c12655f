"""Run the node with the virtual sensor under ROS 2, and check the messages on its topics.

    python check_topics.py

The command needs rclpy, isocharge with the extra `simulate`, and the built package `isocharge_ros`. `pixi run check`
provides all of them. The exit code is 1 if the messages are not as expected.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

SECONDS = 30.0
"""Time in which messages are collected, s."""

FORCE_RANGE_N = (0.03, 3.0)
"""Forces with which the virtual sensor presses are in this range, N."""


def problems(messages):
    """Return one sentence for each property that the messages do not have.

    Args:
        messages: Messages by topic, in the order of their arrival.
    """
    topics = ("/isocharge/wrench", "/isocharge/pose", "/isocharge/flags", "/diagnostics")
    silent_topics = [topic for topic in topics if not messages.get(topic)]
    if silent_topics:
        return [f"{topic}: expected messages, got none" for topic in silent_topics]

    found = []
    wrenches = {stamp(message): message.wrench for message in messages["/isocharge/wrench"]}
    largest_force_N = max(-wrench.force.z for wrench in wrenches.values())
    if not FORCE_RANGE_N[0] <= largest_force_N <= FORCE_RANGE_N[1]:
        found.append(f"/isocharge/wrench: expected a largest force in {FORCE_RANGE_N} N, got {largest_force_N:.3g} N")
    for message in messages["/isocharge/pose"]:
        wrench = wrenches.get(stamp(message))
        if wrench is None:  # ROS 2 has lost the wrench, which the quality of service "best effort" allows
            continue
        x_m, y_m = message.pose.pose.position.x, message.pose.pose.position.y
        moment_Nm = (y_m * wrench.force.z, -x_m * wrench.force.z)
        if max(abs(wrench.torque.x - moment_Nm[0]), abs(wrench.torque.y - moment_Nm[1])) > 1e-9:
            found.append(f"torque of the wrench at {stamp(message)}: expected the moment of the force at the pose")
            break
    if not any("tare" in message.data for message in messages["/isocharge/flags"]):
        found.append("/isocharge/flags: expected the flag 'tare' at the start, got none")
    names = {status.name for message in messages["/diagnostics"] for status in message.status}
    if "isocharge: film" not in names:
        found.append(f"/diagnostics: expected the status 'isocharge: film', got {sorted(names)}")
    return found


def stamp(message):
    """Return the time of a message as (seconds, nanoseconds)."""
    return message.header.stamp.sec, message.header.stamp.nanosec


def collected_messages(seconds):
    """Return the messages that arrive on the topics of the node in the given time, by topic."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
    from rclpy.qos import qos_profile_sensor_data
    from std_msgs.msg import String

    kinds = {
        "/isocharge/wrench": WrenchStamped,
        "/isocharge/pose": PoseWithCovarianceStamped,
        "/isocharge/flags": String,
        "/diagnostics": DiagnosticArray,
    }
    messages = {topic: [] for topic in kinds}
    rclpy.init()
    node = rclpy.create_node("check_topics")
    for topic, kind in kinds.items():
        node.create_subscription(kind, topic, messages[topic].append, qos_profile_sensor_data)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    node.destroy_node()
    rclpy.shutdown()
    return messages


def main():
    """Start the virtual sensor and the node, collect the messages, and print what is wrong with them."""
    with tempfile.TemporaryDirectory() as folder:
        board = str(Path(folder) / "board")
        commands = (
            ["isocharge", "serve", "virtual", "three-25um-biaxial", "--link", board],
            ["ros2", "run", "isocharge_ros", "node", "--ros-args", "-p", f"port:={board}"],
        )
        processes = [subprocess.Popen(words) for words in commands]
        try:
            messages = collected_messages(SECONDS)
        finally:
            for process in reversed(processes):
                process.terminate()
                process.wait(timeout=20)
    for topic, received in messages.items():
        print(f"{topic}: {len(received)} messages")
    found = problems(messages)
    print("\n".join(found) or "all topics are as expected")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
