"""Writer of the ONNX file of a network, and reader that recovers the network from such a file.

The reader extracts the constants of a graph, makes a new graph with these constants, and compares both graphs.
Therefore, only `FoldedNetwork` defines the structure of the graph. The reader refuses graphs that another program
wrote. Before a graph is released, its outputs in single precision are compared with its outputs in double precision.
"""

from collections.abc import Callable, Sequence

import numpy as np
import onnx
import onnx.parser
import onnxruntime as ort
from onnx import helper, numpy_helper

from isocharge.common.arrays import LARGEST, Array, Booleans, Singles
from isocharge.common.errors import ModelError, TrainingError, cut
from isocharge.serve.model.session import FLOORS, RELATIVE_TOLERANCE, open_session, run
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses
from isocharge.train.training.folded_network import (
    ANGLES,
    ChargeFeatures,
    FoldedNetwork,
    Layer,
    Perceptron,
)


def write_graph(network: FoldedNetwork, properties: dict[str, str]) -> bytes:
    """Write a network as an ONNX file.

    Args:
        network: The network.
        properties: Metadata, which are written into `metadata_props`.

    Returns:
        The ONNX file. Its input is `charge_pC` [n, n_electrode]. Its outputs are `contact` [n, 3], `contact_std` [n,
        3], `contact_correlation` [n, 3] and `misfit` [n, 1]. All tensors are float32.
    """
    model = network.onnx_model()
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def read_graph(onnx_model: bytes, where: str) -> FoldedNetwork:
    """Recover a network from an ONNX file that `write_graph` wrote.

    Args:
        onnx_model: The ONNX file.
        where: Name of the file, for error messages.

    Returns:
        The network. Its arrays are float64, and contain the float32 numbers of the file.

    Raises:
        ModelError: If the file is damaged or was not written by `write_graph`.
    """
    try:
        model = onnx.load_model_from_string(onnx_model)
        onnx.checker.check_model(model, full_check=True)
    except Exception as error:  # protobuf's exceptions have no base in onnx
        raise ModelError(f"{where}: not a valid ONNX file ({cut(str(error))})") from error

    try:
        network = _recover_network(model.graph)
        written_again = network.onnx_model()
        is_equal = written_again.graph == model.graph and written_again.opset_import == model.opset_import
    except (LookupError, ValueError, StopIteration):  # the constants are too few, or their shapes do not fit a network
        is_equal = False
    if not is_equal:
        raise ModelError(f"{where}: expected a graph that isocharge has written, got another graph; export it again")
    return network


def _recover_network(graph: onnx.GraphProto) -> FoldedNetwork:
    """Return the network from which `write_graph` made a graph.

    The graph contains the contact perceptron and the misfit perceptron joined into one perceptron, which is separated
    again. The constants have the order in which `FoldedNetwork.onnx_model` adds them. First come the constants of the
    features, and then the constants of the hidden layers, the weights of the skip layer, and the bias and the weights
    of the last layer.

    Args:
        graph: The graph.

    Raises:
        LookupError: If the graph has no nodes.
        ValueError: If there is no hidden layer, the shapes of the constants do not fit a network, or a constant is not
            finite.
        StopIteration: If the graph has too few constants.
    """
    operators = [node.op_type for node in graph.node]
    n_hidden = operators.count("Tanh")  # one after each hidden layer
    is_signed = operators[0] == "Max"  # the first node of a graph for charges of both signs

    # Take the constants one after the other from an iterator, in their order in the graph.
    constants = (np.asarray_chkfinite(numpy_helper.to_array(tensor), dtype=float) for tensor in graph.initializer)
    low_pC = next(constants)
    high_pC = next(constants)
    typical_pC = 1.0 / next(constants)  # the graph contains the inverse, because it multiplies
    mean = next(constants) if is_signed else None
    features = ChargeFeatures(typical_pC, low_pC, high_pC, mean)
    hidden = [Layer(weight=next(constants), bias=next(constants)) for _ in range(n_hidden)]
    skip = next(constants)
    bias = next(constants)
    last = Layer(weight=next(constants), bias=bias)
    # ONNX repeats a single number for all columns, but the C code does not, so such a bias is refused. The last
    # bias must also fit the columns of the skip layer.
    layers = (*hidden, last, Layer(skip, bias))
    has_biases = all(layer.bias.shape == layer.weight.shape[1:] for layer in layers)
    if not (hidden and has_biases):
        raise ValueError("expected hidden layers, and a bias for each column of the weights")

    # In each layer, the units of the contact perceptron come first, and those of the misfit perceptron follow. Find the
    # index of the first unit of the misfit perceptron in each layer, from the last layer backwards. In the last layer,
    # the units are the answers. The angles are the last answers about the contact, so the misfit begins after them.
    first_misfit_units = [ANGLES.stop]
    # For a hidden layer, use the weights of the next layer. They have one row for each unit of the hidden layer, and a
    # column for each unit of the next layer. Only units of the misfit perceptron have weights for units of the misfit
    # perceptron in the next layer. `hidden[0]` is not the next layer of any hidden layer.
    for next_layer in (last, *reversed(hidden[1:])):
        weights_for_misfit_units = next_layer.weight[:, first_misfit_units[0] :]
        is_misfit_unit = weights_for_misfit_units.any(axis=1)
        first_misfit_units.insert(0, int(is_misfit_unit.argmax()))  # argmax finds the first True

    # Separate the two perceptrons: the units before the first misfit unit of each layer, and the units from it on.
    joined = Perceptron(tuple(hidden), last, skip)
    contact = _select_units(joined, [slice(start) for start in first_misfit_units])
    misfit = _select_units(joined, [slice(start, None) for start in first_misfit_units])
    return FoldedNetwork(features, contact, misfit)


def _select_units(joined: Perceptron, units: list[slice]) -> Perceptron:
    """Return the perceptron that consists of the selected units of several joined perceptrons.

    Args:
        joined: The joined perceptrons, which have the same inputs.
        units: Units of each layer that belong to the perceptron, from the first layer to the last. Each unit is a
            column of the weights of its layer, and a row of the weights of the next layer.
    """
    joined_layers = (*joined.hidden, joined.last)
    units_before = [slice(None), *units[:-1]]  # all inputs before the first layer
    *hidden, last = (
        Layer(weight[rows, columns], bias[columns])
        for (weight, bias), rows, columns in zip(joined_layers, units_before, units, strict=True)
    )
    return Perceptron(tuple(hidden), last, joined.skip[:, units[-1]])


OutputFunction = Callable[[Array], tuple[Array, ...]]
"""Function from charges, shape (n, n_electrode), pC, to the outputs of a network in the order of the graph, float64."""

N_GOLDEN = 64
"""Number of charges from which the golden vectors of a model are chosen.

Three quarters of the charges belong to presses with noise, and a quarter are extreme."""


N_EXTREME = 10_000
"""Number of random combinations of extreme charges for which the outputs must be finite."""

EXTREME_CHARGES_pC = (-LARGEST, LOWEST_CHARGE, LARGEST)
"""Charges for which every output must be finite, pC.

`LARGEST` is the largest float32 number. Before a network computes a logarithm, it raises every charge below a lower
limit to this limit, which is at most `LOWEST_CHARGE`. A negative charge therefore gives the smallest logarithm.
"""


def check_graph(
    graph: bytes,
    compute_exact: OutputFunction,
    presses: LabelledPresses,
    noise: Noise,
    floors: Sequence[float] = FLOORS["contact"],
) -> Singles:
    """Compare the outputs of an ONNX graph with the outputs of its network, and choose charges for the golden vectors.

    Golden vectors are charges together with the outputs for these charges. The golden vectors are stored with a model,
    so that every computer can check its own answers. The outputs of the graph and of the network are compared for noisy
    charges of presses and for extreme charges. At some charges, the outputs depend so strongly on the charges that the
    rounding of float32 numbers matters. Such charges do not become golden vectors. For many further extreme charges,
    the function only checks that the outputs are finite.

    Args:
        graph: The ONNX file.
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses of the film.
        noise: Noise of good presses.
        floors: Floors of x and y, mm, and of the force, N, which replace the default floors. The tolerance of an output
            is proportional to the larger of two numbers: the magnitude of the output and its floor.

    Returns:
        Charges for the golden vectors, float32, shape (n, n_electrode) with n up to `N_GOLDEN`, pC.

    Raises:
        TrainingError: If an output is not finite, or the graph and the network disagree.
    """
    session = open_session(graph, "the exported graph")
    candidate_charge = _choose_golden_charges(compute_exact, presses, noise)
    _check_finite_outputs(session, n_electrode=presses.charge.shape[1])
    # Find the presses for which every difference is less than a quarter of the tolerance. The rest of the tolerance is
    # left to other runtimes, which round differently.
    all_floors = FLOORS | {"contact": floors, "contact_std": floors}
    is_reproducible: Booleans = np.full(len(candidate_charge), True)
    exact_outputs = compute_exact(candidate_charge.astype(float))
    for exact, (name, output) in zip(exact_outputs, run(session, candidate_charge).items(), strict=True):
        tolerance = 0.25 * RELATIVE_TOLERANCE * np.maximum(np.abs(exact), all_floors[name])
        is_reproducible &= (np.abs(output - exact) < tolerance).all(axis=1)
    agreeing_count = np.count_nonzero(is_reproducible)
    # If fewer than a quarter of the presses agree, the cause is not only the rounding at some charges.
    if agreeing_count < N_GOLDEN // 4:
        raise TrainingError(
            f"expected outputs of the exported graph that agree with those of the network within the rounding error of "
            f"float32, got {agreeing_count} of {len(candidate_charge)} presses that agree; train with more steps or "
            "another seed"
        )
    return candidate_charge[is_reproducible]


def _choose_golden_charges(compute_exact: OutputFunction, presses: LabelledPresses, noise: Noise) -> Singles:
    """Choose charges for the golden vectors, with which every computer can check its answers.

    Three quarters of the chosen charges are charges of presses, and one quarter are extreme charges.

    A press is only used if the standard deviation of its position is at most the median over all presses. For presses
    with larger standard deviations, a small change of a charge may move the estimated position by millimetres. For such
    presses, two runtimes that round float32 numbers differently could give outputs that differ by more than the
    tolerance of the golden vectors.

    Args:
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses without noise.
        noise: Noise that is added to the charges.

    Returns:
        Charges, shape (N_GOLDEN, n_electrode), pC.
    """
    _, std, *_ = compute_exact(presses.charge)
    position_std = std[:, 0] + std[:, 1]  # a measure of the uncertainty of x and y
    well_determined_presses = presses[position_std <= np.median(position_std)]

    chosen_rows = np.linspace(0, len(well_determined_presses) - 1, 3 * N_GOLDEN // 4).astype(int)
    press_charge = well_determined_presses[chosen_rows].noisy(noise, seed=2)  # charges with noise

    # The last quarter has charges of presses times factors from 0.001 to 1000, zero charges and negative charges.
    factor = np.geomspace(1e-3, 1e3, N_GOLDEN // 4)
    extreme_charge = press_charge[: len(factor)] * factor[:, None]  # one factor for all charges of a press
    extreme_charge[0] = 0.0
    extreme_charge[1] = -extreme_charge[1]
    return np.concatenate([press_charge, extreme_charge]).astype(np.float32)


def _check_finite_outputs(session: ort.InferenceSession, n_electrode: int) -> None:
    """Check that all outputs are finite for random combinations of `EXTREME_CHARGES_pC`.

    The network was not trained with such charges, so its outputs are extrapolations.

    Args:
        session: The exported graph.
        n_electrode: Number of charges of a press.

    Raises:
        TrainingError: If an output is infinite or NaN.
    """
    rng = np.random.default_rng(4)
    charges = rng.choice(np.array(EXTREME_CHARGES_pC, np.float32), (N_EXTREME, n_electrode))
    for name, output in run(session, charges).items():
        is_finite = np.isfinite(output).all(axis=1)  # one value for each row of charges
        if not is_finite.all():
            row = np.argmin(is_finite)  # the first row that is not finite
            raise TrainingError(
                f"the network answers {name} = {output[row]} to the charges {charges[row]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )
