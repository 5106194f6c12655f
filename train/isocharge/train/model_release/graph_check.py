"""Comparison of an exported ONNX graph with the network from which it was written."""

from collections.abc import Callable, Sequence

import numpy as np
import onnxruntime as ort

from isocharge.common.arrays import Array, Booleans, Singles
from isocharge.common.errors import TrainingError
from isocharge.serve.model.golden import FLOORS, RELATIVE_TOLERANCE
from isocharge.serve.model.session import CORRELATION, open_session, run
from isocharge.serve.presses.number_table import LARGEST
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

OutputFunction = Callable[[Array], tuple[Array, ...]]
"""Function from charges, shape (n, n_electrode), pC, to the outputs of a network in the order of the graph, float64."""

N_GOLDEN = 64
"""Number of charges from which the golden vectors of a model are chosen.

Three quarters of the charges belong to presses with noise, and a quarter are extreme."""

TOLERANCES = {"contact": 1e-4, "contact_std": 1e-4, CORRELATION: 2e-3, "misfit": 2e-3}
"""Largest relative difference of each output between the graph (float32) and the network.

Rounding errors grow with the number of layers. For some presses, the position depends so strongly on the charges that
float32 has too few digits.
"""

N_COMPARED = 10_000
"""Number of presses with noise on which the graph and the network are compared, and number of extreme presses."""

EXTREME_CHARGES_pC = (-LARGEST, LOWEST_CHARGE, LARGEST)
"""Charges for which every output must be finite, pC.

`LARGEST` is the largest float32 number. Charges below `LOWEST_CHARGE` are set to `LOWEST_CHARGE` before their logarithm
is computed. Therefore, `LOWEST_CHARGE` gives the smallest logarithm.
"""

STD_FACTOR = 100.0
"""Smallest number by which a difference of a contact is divided, in standard deviations of the contact.

A difference of a hundredth of a standard deviation is negligible. With this divisor, such a difference is within the
tolerance."""


def check_graph(
    graph: bytes,
    compute_exact: OutputFunction,
    presses: LabelledPresses,
    noise: Noise,
    floors: Sequence[float] = FLOORS["contact"],
) -> Singles:
    """Compare a graph with its network, and choose charges for the golden vectors.

    Golden vectors are stored with a model, so that every computer can check its answers. The outputs of the graph and
    of the network are compared for noisy charges of presses and for extreme charges. Charges on which the outputs
    depend on the rounding of float32 numbers do not become golden vectors.

    Args:
        graph: The ONNX file.
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses of the film.
        noise: Noise of good presses.
        floors: Values of x and y, mm, and of the force, N, below which differences count as absolute differences.

    Returns:
        Charges for the golden vectors, float32, shape (n, n_electrode) with n up to `N_GOLDEN`, pC.

    Raises:
        TrainingError: If an output is not finite, or the graph and the network disagree.
    """
    session = open_session(graph, "the exported graph")
    ordinary_charge, extreme_charge = _choose_golden_charges(compute_exact, presses, noise)
    _check_finite_outputs(session, n_electrode=presses.charge.shape[1])
    noisy_charge = presses.repeated(N_COMPARED)[:N_COMPARED].noisy(noise, seed=3).astype(np.float32)
    _compare(session, compute_exact, np.concatenate([noisy_charge, extreme_charge]), floors)
    golden_charge: Singles = np.concatenate([ordinary_charge, extreme_charge])
    # The rounding error must be well below the tolerance, because the rounding of another runtime is different.
    all_floors = FLOORS | {"contact": tuple(floors), "contact_std": tuple(floors)}
    is_reproducible: Booleans = np.full(len(golden_charge), True)
    exact_outputs = compute_exact(golden_charge.astype(float))
    for exact, (name, output) in zip(exact_outputs, run(session, golden_charge).items(), strict=True):
        tolerance = RELATIVE_TOLERANCE * np.maximum(np.abs(exact), all_floors[name])
        is_reproducible &= (np.abs(output - exact) < 0.25 * tolerance).all(axis=1)
    return golden_charge[is_reproducible]


def _choose_golden_charges(
    compute_exact: OutputFunction, presses: LabelledPresses, noise: Noise
) -> tuple[Singles, Singles]:
    """Choose charges for the golden vectors.

    Three quarters are charges of presses, and one quarter are extreme charges.

    Presses are only used if the standard deviation of their position is at most the median of all presses. For presses
    with larger standard deviations, a small change of a charge may move the estimated position by millimetres. On these
    presses, two runtimes that round float32 numbers differently could differ by more than the tolerance of the golden
    vectors.

    Args:
        compute_exact: Function that computes the outputs of the network in double precision.
        presses: Presses without noise.
        noise: Noise that is added to the charges.

    Returns:
        Charges of presses, shape (n, n_electrode), and extreme charges, shape (m, n_electrode), pC.
    """
    _, std, *_ = compute_exact(presses.charge)
    position_std = std[:, 0] + std[:, 1]  # a measure of the uncertainty of x and y
    well_determined_presses = presses[np.flatnonzero(position_std <= np.median(position_std))]

    chosen_rows = np.linspace(0, len(well_determined_presses) - 1, 3 * N_GOLDEN // 4).astype(int)
    press_charge = well_determined_presses[chosen_rows].noisy(noise, seed=2)

    # The last quarter has charges of presses times factors from 0.001 to 1000, zero charges and negative charges.
    factor = np.geomspace(1e-3, 1e3, N_GOLDEN // 4)
    extreme_charge = press_charge[: len(factor)] * factor[:, None]  # one factor for all charges of a press
    extreme_charge[0] = 0.0
    extreme_charge[1] = -extreme_charge[1]
    return press_charge.astype(np.float32), extreme_charge.astype(np.float32)


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
    charges = rng.choice(np.array(EXTREME_CHARGES_pC, np.float32), (N_COMPARED, n_electrode))
    for name, output in run(session, charges).items():
        is_finite = np.isfinite(output).all(axis=1)  # one value for each row of charges
        if not is_finite.all():
            row = int(np.argmin(is_finite))  # the first row that is not finite
            raise TrainingError(
                f"the network answers {name} = {output[row]} to the charges {charges[row]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )


def _compare(
    session: ort.InferenceSession, compute_exact: OutputFunction, charge: Singles, floors: Sequence[float]
) -> None:
    """Check that the graph and the network agree within `TOLERANCES` for all presses.

    Args:
        session: The graph.
        compute_exact: Function that computes the outputs of the network in double precision.
        charge: Charges, shape (n, n_electrode), pC.
        floors: Values of x and y, mm, and of the force, N, below which differences count as absolute differences.

    Raises:
        TrainingError: If the graph and the network disagree.
    """
    expected_outputs = compute_exact(charge.astype(float))
    _, expected_std, *_ = expected_outputs
    # A difference is divided by the magnitude of the expected value, or by the smallest divisor if this is larger.
    smallest_contact_divisor = np.maximum(floors, STD_FACTOR * expected_std)  # shape (n, 3)
    for expected, (name, graph_output) in zip(expected_outputs, run(session, charge).items(), strict=True):
        smallest_divisor = smallest_contact_divisor if name in ("contact", "contact_std") else 1.0
        divisor = np.maximum(np.abs(expected), smallest_divisor)
        difference = float(np.max(np.abs(expected - graph_output) / divisor))
        if not difference <= TOLERANCES[name]:
            raise TrainingError(
                f"the exported graph disagrees with the network on {name}: expected a relative difference of at most "
                f"{TOLERANCES[name]:g}, got {difference:.3g}"
            )
