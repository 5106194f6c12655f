"""Charge series against closed forms and finite differences, and the reader of `charges.npz`."""

import io

import numpy as np
import pytest

from drawn_contacts import draw_contacts
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError
from isocharge.serve.model.charge_file import FILE, charge_map_bytes, read_charge_map
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate.forward.charge_map import differences

ELECTRODES = tuple("ABCD")
DOMAIN = Domain(8.0, (0.05, 2.0))
NODES = np.array([-0.5, 0.0, 0.25])
OFFSET_pC = np.array([3.5, -1.0, 0.0, 2.0])
CONTACTS = draw_contacts(1, 20, 7.5, (0.055, 1.8))


def random_series(*, is_signed=False):
    """Return a series with three nodes, two directions of other degrees, and random coefficients."""
    rng = np.random.default_rng(0)
    coefficients = 0.1 * rng.normal(size=(3, 4, 4, 3, 4))
    if not is_signed:
        coefficients[:, 0, 0, :2] += np.array([[5.0], [1.2]])
    coefficients[:, np.add.outer(range(4), range(4)) > 3] = 0.0
    directions = 0.05 * rng.normal(size=(2, 2, 1, 2, 2, 4))
    directions[1, 1] = 0.0
    return ChargeSeries(
        domain=DOMAIN,
        electrodes=ELECTRODES,
        coefficients=coefficients.astype(np.float32).astype(float),
        node_MPa=NODES,
        directions=directions.astype(np.float32).astype(float),
        log_size=np.array([4.0, 1.0, -0.1]) if is_signed else None,
        charge_std=0.004,
        offset_pC=OFFSET_pC,
        pretension_MPa=0.8,
        tension_std_MPa=0.1,
    )


def polynomial_values(series, contact, state):
    """Compute v with NumPy's polynomials: `chebval3d`, and `polyfit` through the nodes."""
    unit = series.domain.to_unit(contact)
    node_values = [np.polynomial.chebyshev.chebval3d(*unit.T, node) for node in series.coefficients]
    by_node = np.array(node_values)  # shape (n_node, n_electrode, n)
    polynomial = np.polyfit(series.node_MPa, by_node.reshape(len(by_node), -1), len(by_node) - 1)
    value = np.polyval(polynomial, state[0]).reshape(by_node.shape[1:])
    at_zero, slopes = np.polynomial.chebyshev.chebval3d(*unit.T, series.directions)  # shapes (K, n_electrode, n)
    return (value + np.tensordot(state[1:], at_zero + state[0] * slopes, axes=1)).T


@pytest.mark.parametrize("is_signed", [False, True])
def test_charges_at_any_state_are_those_of_numpy_polynomials(is_signed):
    series = random_series(is_signed=is_signed)
    state = np.array([0.13, 0.7, -1.2])
    value = polynomial_values(series, CONTACTS, state)
    unit_log_force = series.domain.to_unit(CONTACTS)[:, 2]
    expected = np.exp(value)
    if is_signed:
        expected = value * np.exp(np.polynomial.chebyshev.chebval(unit_log_force, series.log_size))[:, None]
    expected += OFFSET_pC
    np.testing.assert_allclose(series.in_state(CONTACTS, state).charge_pC, expected, rtol=1e-10)
    calibrated_pC = series.in_state(CONTACTS, np.zeros(3)).charge_pC
    np.testing.assert_allclose(series.charges(CONTACTS), calibrated_pC, rtol=1e-12)


@pytest.mark.parametrize("is_signed", [False, True])
def test_derivatives_are_finite_differences_also_outside_the_range_of_forces(is_signed):
    series = random_series(is_signed=is_signed)
    contact = CONTACTS.copy()
    contact[:3, 2] = [1e-3, 0.02, 7.0]
    state = np.array([-0.2, 0.5, 1.0])
    changes = series.in_state(contact, state)
    step = 1e-6
    for number, change in enumerate(step * np.eye(3)):
        up, down = (series.in_state(contact, state + sign * change).charge_pC for sign in (1.0, -1.0))
        np.testing.assert_allclose(changes.by_state[:, :, number], (up - down) / (2.0 * step), rtol=1e-6, atol=1e-6)
    expected = differences(lambda stepped: series.in_state(stepped, state).charge_pC, contact, (step, step, step))
    np.testing.assert_allclose(changes.by_contact[:, :, 2], expected[:, :, 2], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(changes.by_contact[3:], expected[3:], rtol=1e-5, atol=1e-5)


def test_charges_beyond_the_domain_continue_linearly_in_position_and_as_a_power_of_the_force():
    series = random_series()
    edge = np.array([[8.0, 0.0, 2.0]])
    charge, slope = series.linearised(edge)
    log_slope = slope / (charge - OFFSET_pC)[:, :, None]
    beyond = series.charges(np.array([[9.0, 0.0, 2.0], [8.0, 0.0, 6.0]])) - OFFSET_pC
    np.testing.assert_allclose(beyond[0], (charge[0] - OFFSET_pC) * np.exp(log_slope[0, :, 0]), rtol=1e-10)
    np.testing.assert_allclose(beyond[1], (charge[0] - OFFSET_pC) * 3.0 ** log_slope[0, :, 2], rtol=1e-10)
    assert np.isfinite(series.charges(np.array([[1e9, 0.0, 1e-300], [0.0, -1e9, 1e300]]))).all()


@pytest.mark.parametrize("is_signed", [False, True])
def test_file_is_read_as_it_was_written(is_signed, tmp_path):
    written = random_series(is_signed=is_signed)
    (tmp_path / FILE).write_bytes(charge_map_bytes(written))
    read = read_charge_map(tmp_path, ELECTRODES)
    state = np.array([0.1, 1.0, -1.0])
    np.testing.assert_array_equal(read.in_state(CONTACTS, state).charge_pC, written.in_state(CONTACTS, state).charge_pC)
    for name in ("domain", "electrodes", "is_folded", "charge_std", "pretension_MPa", "tension_std_MPa"):
        assert getattr(read, name) == getattr(written, name)


@pytest.mark.parametrize(
    ("left_out", "electrodes", "reason"),
    [
        ("format", ELECTRODES, r"format 1 is not supported \(this version reads 3\)"),
        ("series", ELECTRODES, "'series'"),
        ("", tuple("ABC"), r"series: expected charges of \('A', 'B', 'C'\), got .*4\)"),
    ],
)
def test_file_of_another_format_or_model_is_refused(left_out, electrodes, reason, tmp_path):
    arrays = np.load(io.BytesIO(charge_map_bytes(random_series())))
    np.savez_compressed(tmp_path / FILE, **{name: array for name, array in arrays.items() if name != left_out})
    with pytest.raises(ModelError, match=rf"charges\.npz: .*{reason}.*train again"):
        read_charge_map(tmp_path, electrodes)


def test_model_without_the_file_has_no_map(tmp_path):
    assert read_charge_map(tmp_path, ELECTRODES) is None
