"""Worker processes of commands that have no option for their number."""

from dataclasses import replace

from isocharge.cli.shared.forward_maps import solving_executor
from isocharge.simulate import load_sensor
from isocharge.simulate.execution import cores


def test_only_a_film_that_takes_long_is_solved_by_several_processes():
    """A film without axial symmetry takes minutes, and an axisymmetric film takes seconds."""
    film = load_sensor("three-25um-biaxial").film
    with solving_executor(film) as executor:
        assert executor is None
    with solving_executor(replace(film, oval=0.01)) as executor:
        assert (executor is None) == (cores() == 1)
