"""Parsing of numbers in texts that were written by people or devices."""


def parse_number(text: str) -> float:
    """Parse a number in ASCII characters. Infinity and NaN are also accepted.

    Unlike `float`, the function accepts neither underscores, as in `1_0`, nor digits of other scripts, because other
    programs do not write numbers in these notations.

    Args:
        text: The number as text, such as "-1.5e3".

    Raises:
        ValueError: If the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"expected a number, got {text[:100]!r}")
    return float(text)
