"""How fast predictions are on this machine: in process and over HTTP, every contender in turn.

May import: prediction.
"""

from isocharge.serve.benchmark.contenders import in_process_contenders, press_charges
from isocharge.serve.benchmark.http_client import HttpLoad
from isocharge.serve.benchmark.machine import machine
from isocharge.serve.benchmark.timing import Contender, Timing, take_turns

__all__ = ["Contender", "HttpLoad", "Timing", "in_process_contenders", "machine", "press_charges", "take_turns"]
