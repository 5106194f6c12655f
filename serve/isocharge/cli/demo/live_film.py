"""`isocharge demo --live`: a virtual sensor on the live page."""

import webbrowser
from contextlib import ExitStack, closing, suppress

from isocharge.cli.shared.live_page import PageFeed, answering, live_page
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import log_to_stderr, progress
from isocharge.cli.shared.virtual_sensor import virtual_sensor


def show_live_film(sensor: str, rate_Hz: float, seed: int, seconds: float | None, in_browser: bool) -> None:
    """Play a virtual sensor, follow it with the released model, and show both on the live page.

    Args:
        sensor: Name of the sensor and of its model.
        rate_Hz: Frames per second.
        seed: Of the presses.
        seconds: Time after which to stop; None for Ctrl-C.
        in_browser: Whether to open the page.
    """
    from isocharge.serve import Policy, Port, Predictor, TouchStream, find_model
    from isocharge.serve.live.recorded_stream import RecordedStream
    from isocharge.serve.network.address import Address
    from isocharge.simulate import Circle, ForwardMap, load_sensor

    predictor = Predictor(sensor)
    with progress("solving the film") as advance:
        forward_map = ForwardMap.build(load_sensor(sensor), Circle(1e-3), progress=advance)
    touch = TouchStream(predictor)
    live = RecordedStream(touch)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        stack.enter_context(log_to_stderr())
        page = live_page(Address(), None, sensor, predictor.metadata, find_model(sensor))
        link, url = stack.enter_context(page)
        board = stack.enter_context(virtual_sensor(forward_map, "reference", seed, rate_Hz))
        port = stack.enter_context(Port(board.url))
        stack.enter_context(answering(link, live, (Policy.every.value, {}, "")))
        if in_browser:
            with suppress(webbrowser.Error, OSError):
                webbrowser.open(url)
        feed = PageFeed(link, touch, live)
        for record, _ in stack.enter_context(closing(live.follow(port))):
            feed.put(record)
            if seconds is not None and touch.counts.records > seconds * rate_Hz:
                break
