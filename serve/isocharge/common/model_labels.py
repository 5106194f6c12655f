"""Names and labels of models.

A name is safe in paths, URLs, pages and config.pbtxt. A label is `NAME/VERSION`, as prediction records carry it. A
label has one slash and no `..`, so it cannot name a path outside of the user's repositories. A foreign file that
contains a label can therefore only select one of the user's own models.
"""

import re
from typing import Annotated

from msgspec import Meta

NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}"
"""Regular expression of the name of a model."""

VERSION_PATTERN = "[1-9][0-9]{0,17}"
"""Regular expression of the version of a model: a whole number of at most 63 bits."""

NAME = re.compile(NAME_PATTERN)
VERSION = re.compile(VERSION_PATTERN)

ModelName = Annotated[str, Meta(pattern=rf"\A{NAME_PATTERN}\Z", description="letters, digits, '-', '_' and '.'")]

ModelLabel = Annotated[
    str, Meta(pattern=rf"\A{NAME_PATTERN}/{VERSION_PATTERN}\Z", description="the label NAME/VERSION of a model")
]
