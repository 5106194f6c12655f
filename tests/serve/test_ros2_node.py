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

from isocharge.serve.flags import MEANINGS
from isocharge.serve.outputs.ros_messages import pose_stamped, ros_time_ns, with_tracked_contact, wrench_stamped
from isocharge.serve.record.record import TrackedContact

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
        elif node == Nodetype.SEQUENCE:
            fields[field] = []
        else:
            fields[field] = np.zeros(description[1])
    return ROS.types[name](**fields | ({"w": 1.0} if name.endswith("Quaternion") else {}))


KINDS = {
    "WrenchStamped": "geometry_msgs",
    "PoseWithCovarianceStamped": "geometry_msgs",
    "String": "std_msgs",
    "DiagnosticArray": "diagnostic_msgs",
    "DiagnosticStatus": "diagnostic_msgs",
    "KeyValue": "diagnostic_msgs",
}
"""Package of each message that the node makes."""

LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2}
"""Constants of a DiagnosticStatus, from its definition (diagnostic_msgs/msg/DiagnosticStatus.msg)."""


@pytest.fixture
def run_node(monkeypatch):
    """Function that runs the node with records in place of a port, and returns the topics and serialised messages."""
    published = []

    class Node:
        def __init__(self, name):
            assert name == "isocharge"

        def create_publisher(self, kind, topic, _):
            name = f"{KINDS[kind.__name__]}/msg/{kind.__name__}"
            return SimpleNamespace(publish=lambda it: published.append((topic, bytes(ROS.serialize_cdr(it, name)))))

        def declare_parameter(self, _, value):
            return SimpleNamespace(value=value)

        def destroy_node(self):
            published.append("destroyed")

    modules = {"rclpy.node": SimpleNamespace(Node=Node)}
    for name, package in KINDS.items():
        constructor = {"__new__": lambda kind, package=package: new_message(f"{package}/msg/{kind.__name__}")}
        kind = type(name, (), constructor | LEVELS)
        setattr(modules.setdefault(f"{package}.msg", SimpleNamespace()), name, kind)
        modules[package] = Mock()
    for name, module in {"rclpy": Mock(), "rclpy.qos": Mock(), **modules}.items():
        monkeypatch.setitem(sys.modules, name, module)

    def run(records):
        module = runpy.run_path(str(NODE))
        module["main"].__globals__.update(Port=lambda *_, **__: nullcontext(), Predictor=str, stream=lambda *_: records)
        module["main"]()
        assert published.pop() == "destroyed"
        return published

    return run


def numbers(message):
    """The doubles at the end of a CDR message, and what is before them; -0 is 0."""
    count = 6 if len(message) < 200 else 43
    return np.array(struct.unpack(f"<{count}d", message[-8 * count :])) + 0.0, message[: -8 * count]


def test_the_node_publishes_flags_and_diagnostics_once_a_second(run_node, record):
    """The clock of the computer is set back before each record, which makes no difference."""
    start_s = 1763600000.0
    flags = [(), ("gap",), (), ("invalid", "gap"), (), ()]  # of records 0.4 s apart
    records = [record(flags=one, timestamp=start_s - 0.4 * number, force_N=None) for number, one in enumerate(flags)]
    sent = run_node(records)
    texts = [ROS.deserialize_cdr(data, "std_msgs/msg/String").data for topic, data in sent if topic.endswith("flags")]
    assert texts == ["", "gap", "", "invalid,gap", "", ""]
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    diagnostics = [ROS.deserialize_cdr(data, kind) for topic, data in sent if topic == "/diagnostics"]
    assert [one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec for one in diagnostics] == pytest.approx(
        [start_s, start_s - 1.2]
    )
    first, second = (one.status[0] for one in diagnostics)
    assert (first.level, first.message, first.hardware_id) == (LEVELS["OK"], "no flags", "linear-film")
    assert (second.level, MEANINGS["gap"] in second.message) == (LEVELS["ERROR"], True)
    values = {pair.key: pair.value for pair in second.values}
    assert (values["records"], values["gap"], values["invalid"]) == ("3", "2", "1")


def test_the_node_publishes_what_an_mcap_file_holds(run_node, record):
    press = {
        "y_mm": -2.5,
        "force_N": 0.75,
        "x_std_mm": 0.05,
        "y_std_mm": 0.0625,
        "force_std_N": 0.01,
        "xy_correlation": 0.25,
    }
    tracked = TrackedContact(1.0, -3.0, 0.5, 0.01, 0.02, 0.001, 0.0, 0.0, 0.1)
    records = [
        record(**press, sections=("track",), tracked=tracked),
        record(**press, contact=False),
        record(contact=False),
    ]
    sent = [one for one in run_node(records) if one[0] in ("/isocharge/wrench", "/isocharge/pose")]
    expected = []
    for one in records[:2]:
        fields = with_tracked_contact(one.json_values)
        expected.append(("/isocharge/wrench", wrench_stamped(fields, ros_time_ns(fields))))
        if one.contact:
            expected.append(("/isocharge/pose", pose_stamped(fields, ros_time_ns(fields))))
    for (topic, message), (expected_topic, line) in zip(sent, expected, strict=True):
        values, head = numbers(message)
        expected_values, expected_head = numbers(line)
        assert (topic, head) == (expected_topic, expected_head)
        np.testing.assert_allclose(values, expected_values, rtol=1e-12, atol=0.0)
