"""The program grows only where ``budget.toml`` was changed in the same commit, with the reason beside the number."""

import pytest

from tests.counting import KINDS, PACKAGES, budget, code_lines, constants, counted

SOURCE = '''"""Module."""
import os

LIMIT, _NAMES = 3.0, ("a", "b")  # a comment
TABLE: dict[str, float] = {"x": 1.0}
FLAG = True


def f(x):
    """Docstring
    of two lines."""

    return (
        x  # nothing
    )
'''


@pytest.fixture(scope="module")
def found():
    return counted()


@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_package_keeps_to_its_budget(package, kind, found):
    allowed = budget()[package][kind]
    assert found[package][kind] <= allowed, (
        f"{package}: {found[package][kind]} {kind}, budget.toml allows {allowed}: let a mechanism that exists cover "
        "the case, or change budget.toml in this commit with the reason beside the number"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_the_budget_is_no_wider_than_the_program(package, found):
    """What was saved is not to be spent in silence: the budget follows within one in fifty."""
    for kind in KINDS:
        assert budget()[package][kind] <= max(1.02 * found[package][kind], found[package][kind] + 3), kind


def test_lines_of_code_are_those_that_do_something():
    assert code_lines(SOURCE) == 7


def test_constants_are_names_in_capitals_with_a_number():
    assert constants(SOURCE) == 2
