"""Import names of the packages of each extra, from the project file."""

import re
import tomllib

from kept import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

REQUIREMENTS = PROJECT["optional-dependencies"]

IMPORT_NAMES = {"scikit-learn": "sklearn", "grpcio": "grpc"}
"""Names under which packages are imported, if they are not the names of the distributions."""


def packages_of(extra):
    """Return the packages of an extra and of the extras that it includes.

    protobuf is left out, because it comes with onnxruntime.
    """
    packages = set()
    for requirement in REQUIREMENTS[extra]:
        name, included = re.match(r"([\w-]+)(?:\[(.*)\])?", requirement).groups()
        if included:
            packages |= set().union(*map(packages_of, included.split(",")))
        elif name != "protobuf":
            packages.add(IMPORT_NAMES.get(name, name.replace("-", "_")))
    return packages


PACKAGES = {extra: packages_of(extra) for extra in REQUIREMENTS if extra not in ("all", "dev")}
