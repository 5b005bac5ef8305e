"""What a refusal, a finding or a command's line is known by: its codes; of its words a test holds names and numbers."""

import re
from contextlib import contextmanager

import pytest

from flightmodel.checks import GateError


@contextmanager
def refuses(*codes, names=(), kind=GateError):
    """Expect a refusal by exactly these codes (each once or more), whose text has every name (a regular expression)."""
    with pytest.raises(kind) as caught:
        yield caught
    assert set(caught.value.codes) == set(codes), f"{caught.value.codes}: {caught.value}"
    for name in names:
        assert re.search(name, str(caught.value)), f"no {name} in: {caught.value}"


def printed_codes(text):
    """Codes in brackets at the ends of the lines that a command printed, in their order."""
    return re.findall(r" \[([a-z0-9]+(?:-[a-z0-9]+)*)\]$", text, re.MULTILINE)


def numbers_in(text):
    """All numbers of a text, in their order; digits inside a name are none."""
    return [float(number) for number in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)", text)]
