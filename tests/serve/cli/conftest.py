"""What the tests of the commands share."""

from functools import partial

import pytest
from typer.testing import CliRunner

from isocharge.cli.main import app
from isocharge.serve import VirtualSensor, wander


@pytest.fixture
def presses(tmp_path, film):
    """A CSV of two presses, columns not in the model's order."""
    path = tmp_path / "presses.csv"
    a, b, c = film.charge_pC([1.0, -2.0], [0.5, 3.0], [1.0, 0.25]).T
    path.write_text("C,A,B\n" + "".join(f"{k:.9g},{i:.9g},{j:.9g}\n" for i, j, k in zip(a, b, c, strict=True)))
    return path


@pytest.fixture
def run():
    """A function that runs a command in this process; an error of ours is raised."""

    def invoke(*arguments, stdin=None):
        result = CliRunner().invoke(app, ["serve", *map(str, arguments)], input=stdin)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return invoke


@pytest.fixture
def start(start_command):
    return partial(start_command, "serve")


@pytest.fixture
def sensor(film):
    with VirtualSensor(film.charges, wander(seed=2, seconds=20.0)) as sensor:
        yield sensor
