"""`isocharge demo --live`: a virtual sensor on the live page."""

from contextlib import ExitStack, closing

from isocharge.cli.shared.live_page import (
    PageRequests,
    answering,
    one_page,
    open_in_browser,
    page_feed,
    page_settings,
)
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import log_to_stderr, progress, say
from isocharge.cli.shared.virtual_sensor import virtual_sensor


def show_live_film(
    sensor: str, rate_Hz: float, seed: int, live_port: int, seconds: float | None, in_browser: bool
) -> None:
    """Play a virtual sensor, follow it with the released model, and show both on the live page.

    Args:
        sensor: Name of the sensor and of its model.
        rate_Hz: Frames per second.
        seed: Of the presses.
        live_port: TCP port of the page; 0 takes a free one.
        seconds: Time after which to stop; None for Ctrl-C.
        in_browser: Whether to open the page.
    """
    settings = page_settings("127.0.0.1", live_port, None, False, None, None)
    from isocharge.serve import Policy, Port, Predictor, TouchStream, find_model
    from isocharge.serve.live.recorded_stream import RecordedStream
    from isocharge.simulate import Circle, ForwardMap, load_sensor

    predictor = Predictor(sensor)
    with progress("solving the film") as advance:
        forward_map = ForwardMap.build(load_sensor(sensor), Circle(1e-3), progress=advance)
    touch = TouchStream(predictor)
    live = RecordedStream(touch)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        stack.enter_context(log_to_stderr())
        link, url = stack.enter_context(one_page(sensor, predictor.metadata, find_model(sensor), settings))
        board = stack.enter_context(virtual_sensor(forward_map, "reference", seed, rate_Hz))
        port = stack.enter_context(Port(board.url))
        stack.enter_context(answering(PageRequests(link, live, (Policy.every.value, {}, ""), False)))
        say(f"live page: {url}; Ctrl-C stops")
        if in_browser:
            open_in_browser(url)
        feed = page_feed(link, touch, live, predictor.metadata.electrodes)
        for record, _ in stack.enter_context(closing(live.follow(port))):
            feed.put(record)
            if seconds is not None and touch.counts.records > seconds * rate_Hz:
                break
