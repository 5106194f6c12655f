"""Numbers as people and devices write them in text."""


def number_of(text: str) -> float:
    """The number that a text says, in the notation of other programs: `1_0` and digits of other scripts are none.

    Infinity and NaN are numbers here.

    Raises:
        ValueError: If it says none.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"expected a number, got {text[:100]!r}")
    return float(text)
