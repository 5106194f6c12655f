"""A missing extra says how to get it; any other failed import is not dressed up as one; serving needs none."""

import json
import sys

import pytest

from isocharge.common.errors import MissingExtra, require
from processes import finished


@pytest.mark.parametrize(
    ("extra", "module"),
    [
        ("simulate", "scipy"),
        ("train", "torch"),
        ("grpc", "google.protobuf"),
    ],
)
def test_missing_package_of_an_extra(extra, module):
    with (
        pytest.raises(MissingExtra, match=rf"'{module.partition('.')[0]}'.*pip install 'isocharge\[{extra}\]'"),
        require(extra),
    ):
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)


def test_missing_module_of_isocharge_itself_passes():
    with pytest.raises(ModuleNotFoundError, match=r"isocharge\.nowhere") as caught, require("simulate"):
        import isocharge.nowhere  # noqa: F401
    assert not isinstance(caught.value, MissingExtra)


def test_serving_loads_nothing_heavy():
    code = "import json, sys; import isocharge.serve; isocharge.serve.Predictor; print(json.dumps([*sys.modules]))"
    loaded = set(json.loads(finished([sys.executable, "-c", code]).stdout))
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "scipy", "sklearn", "onnx", "matplotlib", "typer", "rich"}
    assert not loaded & {"isocharge.simulate", "isocharge.train", "isocharge.cli"}
