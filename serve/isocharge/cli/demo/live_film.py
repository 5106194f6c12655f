"""`isocharge demo --live`: a virtual sensor on the live page."""

from contextlib import ExitStack, closing

from isocharge.cli.shared.live_page import PageFeed, answering, live_page
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.cli.shared.virtual_sensor import virtual_sensor
from isocharge.serve import Port, Predictor, TouchStream, find_model
from isocharge.serve.live.recorded_stream import RecordedStream
from isocharge.serve.network.address import Address
from isocharge.simulate import Circle, ForwardMap, load_sensor


def show_live_film(sensor: str, rate_Hz: float, seed: int, address: Address, seconds: float | None) -> None:
    """Play a virtual sensor, follow it with the released model, and show both on the live page.

    Args:
        sensor: Name of the sensor and of its model.
        rate_Hz: Frames per second.
        seed: Of the presses.
        address: Where the page listens.
        seconds: Time after which to stop; None for Ctrl-C.
    """
    predictor = Predictor(sensor)
    with shown_progress():
        forward_map = ForwardMap.build(load_sensor(sensor), Circle(1.0))
    touch = TouchStream(predictor)
    live = RecordedStream(touch)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        link, _ = stack.enter_context(live_page(address, None, sensor, predictor.metadata, find_model(sensor)))
        board = stack.enter_context(virtual_sensor(forward_map, "reference", seed, rate_Hz))
        port = stack.enter_context(Port(board.url))
        stack.enter_context(answering(link, live, ("every", {}, "")))
        say("Ctrl-C stops")
        feed = PageFeed(link, touch, live)
        for record, _ in stack.enter_context(closing(live.follow(port))):
            feed.put(record)
            if seconds is not None and touch.counts.records > seconds * rate_Hz:
                break
