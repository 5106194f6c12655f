"""Launch file of the node: `ros2 launch isocharge_ros film.launch.py parameters:=my_film.yaml`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

DEFAULT_PARAMETER_FILE = str(Path(get_package_share_directory("isocharge_ros")) / "config" / "film.yaml")


def generate_launch_description():
    """Describe the node to ROS 2, which starts the node, and starts it again whenever it has ended."""
    parameters = DeclareLaunchArgument(
        "parameters", default_value=DEFAULT_PARAMETER_FILE, description="file of the node's parameters"
    )
    node = Node(
        package="isocharge_ros",
        executable="node",
        name="isocharge",
        parameters=[LaunchConfiguration("parameters")],
        respawn=True,
    )
    return LaunchDescription([parameters, node])
