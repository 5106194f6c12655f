"""Parsing of numbers in texts from people and devices."""


def parse_number(text: str) -> float:
    """Parse a number in ASCII notation, including infinity and NaN.

    Unlike `float`, the function accepts neither underscores, as in `1_0`, nor digits of other scripts. Other programs
    do not write numbers in this way.

    Raises:
        ValueError: If the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"expected a number, got {text[:100]!r}")
    return float(text)
