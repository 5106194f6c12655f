"""The example of a ROS 2 node, with a stand-in for rclpy, which cannot be had from a package index.

Messages are made from the definitions of ROS 2 that rosbags ships.
"""

import importlib.util
import json
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from isocharge.serve import Predictor, VirtualSensor, stream, wander
from isocharge.serve.export.record_messages import pose_stamped, time_of, wrench_stamped

NODE = Path(__file__).parents[2] / "serve" / "examples" / "ros2_node.py"
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


class Rclpy(types.ModuleType):
    """What the node calls of rclpy; it stops after some messages, as at Ctrl-C."""

    def __init__(self, most):
        super().__init__("rclpy")
        self.calls, self.messages = [], []
        rclpy = self

        class Node:
            def __init__(self, name):
                rclpy.calls.append(f"node {name}")

            def create_publisher(self, kind, topic, quality):
                assert quality == "sensor data"
                return types.SimpleNamespace(publish=lambda message: rclpy.take(topic, kind, message))

            def destroy_node(self):
                rclpy.calls.append("destroy")

        self.init = lambda: self.calls.append("init")
        self.try_shutdown = lambda: self.calls.append("shutdown")
        self.ok = lambda: len(self.messages) < most
        self.node = types.SimpleNamespace(Node=Node)
        self.qos = types.SimpleNamespace(qos_profile_sensor_data="sensor data")

    def take(self, topic, kind, message):
        assert message.__msgtype__ == f"geometry_msgs/msg/{kind.__name__}"
        self.messages.append((topic, bytes(ROS.serialize_cdr(message, message.__msgtype__))))


@pytest.fixture
def rclpy(monkeypatch):
    kinds = {
        kind: type(kind, (), {"__new__": lambda cls: new_message(f"geometry_msgs/msg/{cls.__name__}")})
        for kind in ("WrenchStamped", "PoseWithCovarianceStamped")
    }
    rclpy = Rclpy(most=500)
    modules = {"rclpy": rclpy, "rclpy.node": rclpy.node, "rclpy.qos": rclpy.qos}
    modules |= {"geometry_msgs": types.ModuleType("geometry_msgs"), "geometry_msgs.msg": types.SimpleNamespace(**kinds)}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return rclpy


def node_module():
    spec = importlib.util.spec_from_file_location("ros2_node", NODE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(message):
    """The doubles at the end of a CDR message, and what is before them; -0 is 0."""
    count = 6 if len(message) < 200 else 43
    return np.array(struct.unpack(f"<{count}d", message[-8 * count :])) + 0.0, message[: -8 * count]


def test_the_node_publishes_what_an_mcap_file_holds(rclpy, film, models, monkeypatch):
    module, records = node_module(), []

    def remembered(*words):
        for record in stream(*words):
            records.append(record)
            yield record

    monkeypatch.setattr(module, "stream", remembered)
    monkeypatch.setattr(module, "Predictor", lambda model: Predictor(model, models=models))
    with VirtualSensor(film.charges, wander(seed=2, seconds=20.0)) as sensor:
        module.main("linear", sensor.url)
    assert rclpy.calls == ["init", "node isocharge", "destroy", "shutdown"]
    expected = []
    for record in records:
        fields = {name: getattr(record, name) for name in json.loads(record.to_json())}
        time_ns = time_of(fields)
        expected.append(("/isocharge/wrench", wrench_stamped(fields, time_ns)))
        if record.contact:
            expected.append(("/isocharge/pose", pose_stamped(fields, time_ns)))
    assert any(topic == "/isocharge/pose" for topic, _ in expected)
    for (topic, message), (expected_topic, line) in zip(rclpy.messages, expected, strict=True):
        assert topic == expected_topic
        values, head = numbers(message)
        expected_values, expected_head = numbers(line)
        assert head == expected_head
        np.testing.assert_allclose(values, expected_values, rtol=1e-12, atol=0.0)


def test_the_node_passes_over_what_is_no_number(rclpy, record):
    node = node_module().TouchNode()
    node.publish(record(force_N=None, contact=False))
    assert rclpy.messages == []
