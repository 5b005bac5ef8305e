"""A refusal is known by its codes; of its words a test holds names, lines and numbers."""

import re
from contextlib import contextmanager

import pytest

from flightmodel.checks import GateError


@contextmanager
def refuses(*codes, names=(), kind=GateError):
    """Expect a refusal by exactly these codes (each once or more), whose text has every name (a regular expression)."""
    with pytest.raises(kind) as caught:
        yield caught
    assert set(caught.value.codes) == set(codes), caught.value
    for name in names:
        assert re.search(name, str(caught.value)), f"no {name} in: {caught.value}"
