"""Demo of the live page with a virtual sensor and a released model, and the area in which the presses of a demo lie."""

import math

from isocharge.cli.serve.stream import stream_command
from isocharge.cli.shared.terminal import say, shown_progress, until_stopped
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import ModelError
from isocharge.serve import Predictor, find_model
from isocharge.simulate import Circle, ForwardMap, load_sensor


def played_radius_mm(sensor: str) -> float:
    """Return the largest distance of a press of the demo from the centre of the film, mm.

    If there is a released model with the name of the sensor, the distance is the radius of the working area of this
    model. Otherwise, the distance is `DEFAULT_RADIUS`.

    Args:
        sensor: Name of the sensor.
    """
    try:
        validity = Predictor(sensor).validity
    except ModelError:
        return DEFAULT_RADIUS
    return round(math.sqrt(validity.inscribed_radius_squared_mm2), 2)


def show_live_film(live: str, seconds: float | None, sensor: str) -> None:
    """Play a virtual sensor, estimate its contacts with a released model, and show the contacts on the live page.

    Args:
        live: Value of `--live`: address at which the page listens.
        seconds: Time after which the demo stops, s; None to stop at Ctrl-C.
        sensor: Name of the sensor and of its released model.

    Raises:
        ModelError: If there is no released model with this name.
        InputError: If the address has another form than PORT or HOST:PORT.
    """
    find_model(sensor)  # an unknown model is refused before the film is solved
    with until_stopped():
        with shown_progress():
            radius_mm = played_radius_mm(sensor)
            forward_map = ForwardMap.build(load_sensor(sensor), Circle(1.0), radius_mm, DEFAULT_PLAYED_FORCE_RANGE)
        with virtual_sensor(forward_map) as board:
            say("Ctrl-C stops")
            stream_command(sensor, board.url, output=["none"], live=live, seconds=seconds)
