"""Types of the names and labels of models.

The name of a model consists of characters that are safe in paths, URLs, web pages and the file config.pbtxt. The label
of a model is `NAME/VERSION`. A label contains one slash and no path component `..`. A label can therefore not be the
path of a folder outside the repositories of the user. A file from an untrusted source, such as a recording, can only
select a model in these repositories.
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
