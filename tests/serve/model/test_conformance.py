"""What holds for every model in the top-level `models/` folder, released ones above all."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import text_format
from tritonclient.grpc.model_config_pb2 import TYPE_FP32, ModelConfig

from isocharge.serve import Predictor, find_model, load_model
from isocharge.serve.model.model_folder import model_names
from isocharge.serve.model.session import OUTPUTS

MODELS = Path(__file__).parents[3] / "models"
NAMES = model_names(MODELS)


RELEASED = ("three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial")


@pytest.mark.parametrize("name", RELEASED)
def test_released_models_ship_in_the_wheel(name):
    project = tomllib.loads((MODELS.parent / "pyproject.toml").read_text())
    shipped = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert shipped[f"models/{name}"] == f"isocharge/serve/released/{name}"


@pytest.fixture(params=NAMES)
def model(request):
    return load_model(find_model(MODELS / request.param))


def test_triton_reads_its_configuration(model):
    config = text_format.Parse((model.folder.parent / "config.pbtxt").read_text(), ModelConfig())
    assert (config.name, config.platform) == (model.metadata.name, "onnxruntime_onnx")
    tensors = [(tensor.name, list(tensor.dims)) for tensor in (*config.input, *config.output)]
    widths = {"charge_pC": len(model.metadata.electrodes)} | OUTPUTS
    assert tensors == [(name, [width]) for name, width in widths.items()]
    assert {tensor.data_type for tensor in (*config.input, *config.output)} == {TYPE_FP32}
    assert config.max_batch_size > 1


def test_metadata_and_card_state_the_unnoticed_presses_outside_the_working_area(model):
    unnoticed = model.metadata.unnoticed
    card = (model.folder / "card.md").read_text()
    assert " ".join(unnoticed.summary.split()) in " ".join(card.split())
    assert unnoticed.from_mm == pytest.approx(np.hypot(*model.metadata.working_area_mm[0]), rel=0.02)


def test_answers_are_finite_and_deviations_positive(model):
    """Over all charges a film may give, and some it may not. The predictor compares the golden vectors."""
    rng = np.random.default_rng(0)
    charges = 10.0 ** rng.uniform(0, 4, (2000, len(model.metadata.electrodes)))
    contacts = Predictor(model.folder).predict_batch(charges * rng.choice([-0.1, 1.0, 1.0, 1.0], charges.shape))
    assert all(np.isfinite(column).all() for column in contacts)
    assert min(contacts.x_std_mm.min(), contacts.y_std_mm.min(), contacts.force_std_N.min()) > 0.0
    assert contacts.misfit.min() >= 0.0
    xy, xf, yf = (column.astype(float) for column in contacts[7:])
    one = np.ones_like(xy)
    matrices = np.moveaxis(np.array([[one, xy, xf], [xy, one, yf], [xf, yf, one]]), 2, 0)
    assert np.linalg.eigvalsh(matrices).min() > -2e-5  # a covariance, wherever the model is asked
