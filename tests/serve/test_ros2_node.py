"""The ROS 2 node, with a stand-in for rclpy, which cannot be had from a package index.

Messages are made from the definitions of ROS 2 that rosbags ships.
"""

import runpy
import struct
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from isocharge.serve.export.record_messages import pose_stamped, ros_time_ns, wrench_stamped
from isocharge.serve.record.record import TrackedContact, Tracking

NODE = Path(__file__).parents[2] / "serve/deploy/ros2/isocharge_ros/isocharge_ros/node.py"
ROS = get_typestore(Stores.ROS2_JAZZY)


def new_message(name):
    """A message with zeros, as ROS makes it."""
    fields = {}
    for field, (node, description) in ROS.fielddefs[name][1]:
        if node == Nodetype.NAME:
            fields[field] = new_message(description)
        elif node == Nodetype.BASE:
            fields[field] = {"string": "", "float64": 0.0}.get(description[0], 0)
        else:
            fields[field] = np.zeros(description[1])
    return ROS.types[name](**fields | ({"w": 1.0} if name.endswith("Quaternion") else {}))


@pytest.fixture
def published(monkeypatch):
    """What the node publishes: topic and serialised message."""
    published = []

    class Node:
        def __init__(self, name):
            assert name == "isocharge"

        def create_publisher(self, kind, topic, _):
            name = f"geometry_msgs/msg/{kind.__name__}"
            return SimpleNamespace(publish=lambda it: published.append((topic, bytes(ROS.serialize_cdr(it, name)))))

        def declare_parameter(self, _, value):
            return SimpleNamespace(value=value)

        def destroy_node(self):
            published.append("destroyed")

    names = ("WrenchStamped", "PoseWithCovarianceStamped")
    kinds = {
        name: type(name, (), {"__new__": lambda kind: new_message(f"geometry_msgs/msg/{kind.__name__}")})
        for name in names
    }
    modules = {"rclpy.node": SimpleNamespace(Node=Node), "geometry_msgs.msg": SimpleNamespace(**kinds)}
    for name, module in {"rclpy": Mock(), "rclpy.qos": Mock(), "geometry_msgs": Mock(), **modules}.items():
        monkeypatch.setitem(sys.modules, name, module)
    return published


def numbers(message):
    """The doubles at the end of a CDR message, and what is before them; -0 is 0."""
    count = 6 if len(message) < 200 else 43
    return np.array(struct.unpack(f"<{count}d", message[-8 * count :])) + 0.0, message[: -8 * count]


def test_the_node_publishes_what_an_mcap_file_holds(published, record):
    press = {
        "y_mm": -2.5,
        "force_N": 0.75,
        "x_std_mm": 0.05,
        "y_std_mm": 0.0625,
        "force_std_N": 0.01,
        "xy_correlation": 0.25,
    }
    tracking = Tracking(TrackedContact(1.0, -3.0, 0.5, 0.01, 0.02, 0.001, 0.0, 0.0, 0.1))
    records = [record(**press, tracking=tracking), record(**press, contact=False), record(contact=False)]
    module = runpy.run_path(str(NODE))
    module["main"].__globals__.update(Port=lambda *_, **__: nullcontext(), Predictor=str, stream=lambda *_: records)
    module["main"]()
    assert published.pop() == "destroyed"
    expected = []
    for one in records[:2]:
        fields = one.json_values
        expected.append(("/isocharge/wrench", wrench_stamped(fields, ros_time_ns(fields))))
        if one.contact:
            expected.append(("/isocharge/pose", pose_stamped(fields, ros_time_ns(fields))))
    for (topic, message), (expected_topic, line) in zip(published, expected, strict=True):
        values, head = numbers(message)
        expected_values, expected_head = numbers(line)
        assert (topic, head) == (expected_topic, expected_head)
        np.testing.assert_allclose(values, expected_values, rtol=1e-12, atol=0.0)
