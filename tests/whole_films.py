"""Maps of whole films that the tests solve once, because each takes several seconds."""

from dataclasses import replace

from isocharge.simulate import load_sensor
from isocharge.simulate.forward.whole_film import whole_film_map
from kept import kept


def whole_film_map_solved_once(sensor, probe, force_range, **_executor):
    """Return the coarse map of a film, which is solved once for all layouts of electrodes.

    The solution does not depend on the electrodes.
    """
    layout = load_sensor("three-25um-biaxial")
    solved = kept(whole_film_map, replace(layout, film=sensor.film), probe, force_range)
    return replace(solved, sensor=sensor)
