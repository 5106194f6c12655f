"""How fast predictions are on this machine, every contender in turn."""

from isocharge.serve.benchmark.timing import (
    Contender,
    Timing,
    in_process_contenders,
    machine,
    press_charges,
    take_turns,
)

__all__ = ["Contender", "Timing", "in_process_contenders", "machine", "press_charges", "take_turns"]
