"""Charge table: charges and derivatives, compared with presses that are solved individually."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import Circle, Electrode, SolveSettings, load_sensor, press, touch_charge
from isocharge.simulate.mechanics.theory import theory_for

CENTRES = np.array([[2.0, 1.0], [-7.0, 4.0], [0.5, -12.0]])
TRIANGLE = Electrode("D", ((8.0, -6.0), (12.0, -5.0), (9.0, -2.0))).with_trace(((10.0, -5.0), (12.0, -20.0)), 0.5)
TOLERANCE = (3e-4, 0.01, 0.01, 1e-3, 0.03, 1e-3)
"""Tolerance of each column relative to its largest value. The finite differences with respect to position and probe
radius are less exact, because they cross the kink of the stress under the probe."""


@pytest.mark.parametrize(("name", "at"), [("four-25um-biaxial", (0.7, 0.2)), ("four-25um-uniaxial", (-1.3, 3.1))])
def test_rows_are_the_charges_of_solved_presses_and_their_derivatives(tables, name, at):
    rows = tables[name].rows(np.array([at]), CENTRES, 3.0, (TRIANGLE,))[0]
    sensor = load_sensor(name)
    settings = SolveSettings(theory=theory_for(load_sensor(name), Circle(1.0), (1.0, 1.0)))
    squares = tuple(Electrode.of_square(*named, 3.0) for named in zip("ABC", CENTRES.tolist(), strict=True))

    def charge(x=0.0, y=0.0, log=0.0, radius=0.0, pretension=0.0):
        film = replace(sensor.film, pretension=pretension)
        solved = press(film, Circle(1.0 + radius), (at[0] + x, at[1] + y), float(np.exp(log)), settings)
        return touch_charge(replace(sensor, film=film, electrodes=(*squares, TRIANGLE)), solved)

    steps = {"x": 0.03, "y": 0.03, "log": 0.05, "radius": 0.03}
    differences = [(charge(**{key: h}) - charge(**{key: -h})) / (2.0 * h) for key, h in steps.items()]
    expected = np.stack([charge(), *differences, (charge(pretension=0.1) - charge()) / 0.1], axis=1)
    for number, tolerance in enumerate(TOLERANCE):
        scale = tolerance * np.abs(expected[:, number]).max()
        np.testing.assert_allclose(rows[:, number], expected[:, number], rtol=0.0, atol=scale)
