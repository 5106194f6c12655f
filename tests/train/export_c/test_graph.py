"""Which graphs are written as C, which are refused, and that blocks and int8 weights change no answer."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from isocharge.common.errors import ModelError
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


def rounded(network):
    """A network whose matrix between hidden layers is whole multiples of a scale of each output, as of a student."""
    first, (weights, bias) = network.layers.hidden
    scale = np.abs(weights).max(axis=0) / 127.0
    return replace(network, layers=replace(network.layers, hidden=(first, (np.round(weights / scale) * scale, bias))))


def test_weights_of_8_bits_take_a_byte_each(build, tmp_path):
    network = rounded(random_network(4, (48, 48), (32, 32)))
    folder = written(tmp_path / "small", lambda props: export_onnx(network, props))
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, 4)).astype(np.float32)
    expected = np.concatenate(load_model(folder).session.run(None, {"charge_pC": charge_pC}), axis=1)
    exported = build(folder)
    mine = exported.predict(charge_pC)
    assert np.all(np.abs(mine - expected) <= 1e-5 * np.maximum(np.abs(expected), [1, 1, 0.1, 1, 1, 0.1, 20.0]))
    assert "static const signed char layer_1_weights_0[2304]" in exported.source
    assert "static const signed char layer_1_weights_1[1024]" in exported.source
    assert exported.source.count("signed char layer_") == 2


def test_weights_that_are_no_whole_multiples_stay_floats():
    values = np.random.default_rng(0).standard_normal((20, 10)).astype(np.float32)
    assert Matrix.of(values).scale is None
    scale = np.abs(values).max(axis=0) / np.float32(127)
    whole = Matrix.of((np.round(values / scale) * scale).astype(np.float32))
    assert whole.values.dtype == np.int8
    np.testing.assert_allclose(whole.as_floats(), np.round(values / scale) * scale, rtol=1e-6)
    assert Matrix.of(np.zeros((3, 2), np.float32)).as_floats().tolist() == [[0.0, 0.0]] * 3


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial"])
def test_differences_of_logarithms_halve_the_rounding(name, build):
    """The position in C is nearer to the graph in double precision than that of onnxruntime in single precision."""
    folder = find_model(name)
    constants = {tensor.name: numpy_helper.to_array(tensor).astype(float) for tensor in
                 onnx.load(folder / "model.onnx").graph.initializer}  # fmt: skip
    names = iter(constants)
    low, high, factor, w1, b1, w2, b2, w3, b3, skip, bias, last = (constants[next(names)] for _ in range(12))
    rng = np.random.default_rng(0)
    charge_pC = rng.uniform(0.7, 1.3, (20_000, len(factor))) * np.geomspace(60.0, 3000.0, 20_000)[:, np.newaxis]
    charge_pC = charge_pC.astype(np.float32)
    logs = np.log(np.clip(charge_pC.astype(float), low, high) * factor)
    value = logs
    for weight, shift in ((w1, b1), (w2, b2), (w3, b3)):
        value = np.tanh(value @ weight + shift)
    exact = (value @ last + logs @ skip + bias)[:, :2]
    theirs = load_model(folder).session.run(["contact"], {"charge_pC": charge_pC})[0][:, :2]
    error, others = (
        np.sqrt(np.mean((found - exact) ** 2)) for found in (build(name).predict(charge_pC)[:, :2], theirs)
    )
    assert error < 0.7 * others


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
        (b"nonsense", "not a valid ONNX file"),
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
