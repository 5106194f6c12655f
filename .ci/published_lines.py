"""Replace the installation lines of a clone by those of a version on the package index.

    python .ci/published_lines.py vVERSION

This is a step of a release. The workflow of the release repeats it before the build, so that the description on the
package index is correct. Lines that were replaced before remain.
"""

import sys
import tomllib
from pathlib import Path

PUBLISHED_LINES = {
    "README.md": {
        "pip install .            # in a clone of this repository; Python 3.11 or later": (
            "pip install isocharge    # Python 3.11 or later"
        ),
    },
    "serve/docs/getting_started.md": {
        "pip install .             # in a clone of the repository: the base install": (
            "pip install isocharge             # the base install"
        ),
        "pip install '.[http]'     # with an extra": "pip install 'isocharge[http]'     # with an extra",
        "isocharge is not yet on the package index. ": "",
        "pip install '.[simulate,http]'": "pip install 'isocharge[simulate,http]'",
        "pip install '.[train]'": "pip install 'isocharge[train]'",
        "An extra adds packages: `pip install '.[http]'` in a clone.": (
            "An extra adds packages: `pip install 'isocharge[http]'`."
        ),
    },
}
"""Replacement of each text, by the file."""


def main(tag: str, root: Path) -> None:
    """Replace the installation lines in the files of a checkout, as the table `PUBLISHED_LINES` states.

    The table contains the new text for each old text, by the name of the file. A text that was replaced before remains.

    Args:
        tag: Tag of the release, such as "v1.2.0".
        root: Folder of the checkout.

    Raises:
        SystemExit: If the tag is not the version in `pyproject.toml`, or a file contains neither form of a line.
    """
    version = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    if tag != f"v{version}":
        sys.exit(f"expected the tag v{version} (pyproject.toml), got {tag}: correct the tag or the version")
    for name, replacements in PUBLISHED_LINES.items():
        text = (root / name).read_text("utf-8")
        for before, after in replacements.items():
            if before not in text and after not in text:
                sys.exit(f"{name}: expected the text {before!r} or {after!r}; correct PUBLISHED_LINES")
            text = text.replace(before, after)
        (root / name).write_text(text, "utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path.cwd())
