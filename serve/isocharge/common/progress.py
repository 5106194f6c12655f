"""The callback types with which long work says how far it is and what it noticed."""

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with (done, total)."""

StageProgress = Callable[[int, int, str], None]
"""Called with (done, total, stage): the name of the stage and its latest figure, for people."""

Announce = Callable[[str], None]
"""Called with the name of the step that begins."""

Warn = Callable[[str], object]
"""Called with a sentence that the user should read; the work goes on."""
