"""Which graphs are written as C, which are refused, and that blocks and int8 weights change no answer."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from isocharge.errors import ModelError
from isocharge.serve import find_model, write_model
from isocharge.serve.model.model_folder import load_model
from isocharge.train.export_c.blocks import Block, diagonal_blocks
from isocharge.train.export_c.graph import Matrix, read_graph
from isocharge.train.export_c.workspace import Workspace
from isocharge.train.release.export import export_onnx
from isocharge.train.release.folding import FoldedLayers, FoldedNetwork, PlainPerceptron


def perceptron(rng, *widths):
    """A perceptron of random weights."""
    layers = tuple(
        (rng.standard_normal((a, b)) / np.sqrt(a), 0.3 * rng.standard_normal(b)) for a, b in pairwise(widths)
    )
    return PlainPerceptron(layers, 0.1 * rng.standard_normal((widths[0], widths[-1])))


def random_network(electrodes, contact, misfit, seed=0):
    """A network as ours are, of any widths and number of electrodes."""
    rng = np.random.default_rng(seed)
    parts = [perceptron(rng, electrodes, *contact, 6), perceptron(rng, electrodes, *misfit, electrodes)]
    units = np.diag([8.0, 8.0, *[1.0] * (4 + electrodes)]), np.zeros(6 + electrodes)
    layers = FoldedLayers.of(parts, np.eye(electrodes), np.zeros(electrodes), units)
    return FoldedNetwork(layers, np.full(electrodes, 512.0))


def written(folder, change, names=("A", "B", "C", "D")):
    """A model folder whose graph is `change(metadata properties)`."""
    base = load_model(find_model("four-25um-biaxial"))
    about = replace(base.metadata, name=folder.name, version=1, electrodes=names)
    charges = np.random.default_rng(1).uniform(100.0, 3000.0, (64, len(names))).astype(np.float32)
    return write_model(folder, change(about.to_props()), about, charges, "card")


@pytest.mark.parametrize(
    ("electrodes", "contact", "misfit"),
    [(3, (32, 32), (24, 24)), (4, (5, 7), (9, 3)), (5, (48, 48, 48), (33, 17, 8)), (8, (24,), (16,))],
)
def test_any_width_and_number_of_electrodes(electrodes, contact, misfit, build, tmp_path):
    network = random_network(electrodes, contact, misfit)
    names = tuple(f"E{number} */" for number in range(electrodes))
    folder = written(tmp_path / "random", lambda props: export_onnx(network, props), names)
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, electrodes)).astype(np.float32)
    expected = np.concatenate(network.predict(charge_pC.astype(float)), axis=1)
    mine = build(folder).predict(charge_pC)
    assert np.all(np.abs(mine - expected) <= 1e-5 * np.maximum(np.abs(expected), [1, 1, 0.1, 1, 1, 0.1, 20.0]))


def with_int8_weights(graph, *, by_column):
    """A graph whose second matrix is int8 with scales, as ONNX holds it."""
    model = onnx.load_model_from_string(graph)
    name = [node.input[1] for node in model.graph.node if node.op_type == "Gemm"][1]
    (tensor,) = (entry for entry in model.graph.initializer if entry.name == name)
    weights = numpy_helper.to_array(tensor)
    scale = np.float32(np.abs(weights).max(axis=0) / 127.0 if by_column else np.abs(weights).max() / 127.0)
    model.graph.initializer.remove(tensor)
    model.graph.initializer.extend(
        [
            numpy_helper.from_array(np.int8(np.round(weights / scale)), "q"),
            numpy_helper.from_array(np.array(scale), "q_scale"),
        ]
    )
    axis = {"axis": 1} if by_column else {}
    model.graph.node.insert(0, helper.make_node("DequantizeLinear", ["q", "q_scale"], [name], **axis))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def as_written(folder):
    """A session that computes int8 weights as the graph says: by default onnxruntime rounds their inputs to int8."""
    options = ort.SessionOptions()
    options.add_session_config_entry("session.disable_quant_qdq", "1")
    return ort.InferenceSession(folder / "model.onnx", options, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("by_column", [True, False])
def test_int8_weights_stay_int8_and_answer_as_onnxruntime(by_column, build, tmp_path):
    network = random_network(4, (48, 48), (32, 32))
    folder = written(
        tmp_path / "small", lambda props: with_int8_weights(export_onnx(network, props), by_column=by_column)
    )
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, 4)).astype(np.float32)
    expected = np.concatenate(as_written(folder).run(None, {"charge_pC": charge_pC}), axis=1)
    exported = build(folder)
    mine = exported.predict(charge_pC)
    assert np.all(np.abs(mine - expected) <= 1e-5 * np.maximum(np.abs(expected), [1, 1, 0.1, 1, 1, 0.1, 20.0]))
    assert "static const signed char layer_1_weights_0[2304]" in exported.source


def test_foreign_graphs_are_refused_by_name():
    row = [helper.make_tensor_value_info("charge_pC", TensorProto.FLOAT, ["n", 3])]
    outputs = [helper.make_tensor_value_info("contact", TensorProto.FLOAT, ["n", 3])]
    weights = numpy_helper.from_array(np.ones((3, 3), np.float32), "w")

    def model(*nodes, opset=17, constants=(weights,)):
        graph = helper.make_graph(list(nodes), "foreign", row, outputs, list(constants))
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)]).SerializeToString()

    relu = helper.make_node("Relu", ["charge_pC"], ["contact"])
    scaled = helper.make_node("Gemm", ["charge_pC", "w"], ["contact"], alpha=2.0)
    unknown = helper.make_node("Gemm", ["charge_pC", "charge_pC"], ["contact"])
    narrow = helper.make_node("Gemm", ["charge_pC", "v"], ["contact"])
    alone = helper.make_node("Exp", ["charge_pC"], ["contact"])
    cases = [
        (b"nonsense", "not an ONNX file"),
        (model(relu), "f: node Relu .*expected the operators Log, .*got 'Relu'; this is not a graph of isocharge"),
        (model(scaled), "got alpha = 2.0"),
        (model(unknown), "expected finite float32 constants as input 'charge_pC'"),
        (model(narrow, constants=[numpy_helper.from_array(np.ones((2, 3), np.float32), "v")]), "of 3 rows"),
        (model(alone), "expected outputs of the widths"),
        (model(alone, opset=20), "operators of version 13 to 17 alone, got {'': 20}"),
    ]
    for data, message in cases:
        with pytest.raises(ModelError, match=message):
            read_graph(data, "f")


def test_blocks_hold_all_that_is_not_zero():
    rng = np.random.default_rng(0)
    values = np.zeros((30, 25), np.float32)
    values[:12, :10], values[12:30, 10:25] = rng.random((12, 10)), rng.random((18, 15))
    assert diagonal_blocks(Matrix(values)) == [Block((0, 12), (0, 10)), Block((12, 30), (10, 25))]
    values[5, 24] = 1.0
    assert diagonal_blocks(Matrix(values)) == [Block((0, 30), (0, 25))]
    assert diagonal_blocks(Matrix(np.eye(5, dtype=np.float32))) == [Block((0, 5), (0, 5))]
    assert diagonal_blocks(Matrix(np.zeros((4, 3), np.float32))) == [Block((0, 4), (0, 3))]


def test_rows_that_are_needed_together_lie_apart():
    """The released graph needs two wide arrays and two narrow ones; the logarithms outlive the hidden layers."""
    folder = find_model("four-25um-biaxial")
    graph = read_graph((folder / "model.onnx").read_bytes(), "model")
    space = Workspace.of(graph)
    assert sorted(space.sizes.values(), reverse=True)[:2] == [160, 160]
    assert sum(space.sizes.values()) <= 160 + 160 + 10 + 4
    for node in graph.nodes:
        if node.operator == "Gemm":
            arrays = [space.places[row].array for row in (*node.inputs, *node.outputs)]
            assert len(set(arrays)) == len(arrays)
