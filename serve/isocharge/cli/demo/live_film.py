"""Demo of the live page with a virtual sensor and a released model."""

from isocharge.cli.serve.stream import stream_command
from isocharge.cli.shared.live_page import page_address
from isocharge.cli.shared.terminal import say, shown_progress, until_stopped
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE
from isocharge.simulate import Circle, ForwardMap, load_sensor

DEMO_SENSOR = "three-25um-biaxial"
"""Name of the sensor of the demos, and of its released model."""


def show_live_film(live: str, token: str | None) -> None:
    """Play a virtual sensor, estimate its contacts with a released model, and show the contacts on the live page.

    Args:
        live: Value of `--live`: address at which the page listens.
        token: Value of `--token`.

    Raises:
        InputError: If the address has another form than PORT or HOST:PORT.
    """
    page_address(live)  # a wrong address is refused before the film is solved
    with until_stopped():
        with shown_progress():
            forward_map = ForwardMap.build(
                load_sensor(DEMO_SENSOR), Circle(1.0), force_range=DEFAULT_PLAYED_FORCE_RANGE
            )
        with virtual_sensor(forward_map) as board:
            say("Ctrl-C stops")
            # The released model has the name of its sensor. No records are written, and only the page shows contacts.
            stream_command(DEMO_SENSOR, board.url, output=["none"], live=live, token=token)
