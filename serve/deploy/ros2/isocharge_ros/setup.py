from setuptools import setup

NAME = "isocharge_ros"

setup(
    name=NAME,
    version="1.0.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/film.launch.py"]),
        (f"share/{NAME}/config", ["config/film.yaml"]),
    ],
    install_requires=["isocharge"],
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
