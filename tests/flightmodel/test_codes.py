"""Every refusal and finding has a short stable code, which scripts and tests use instead of its words."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
REFUSALS = ("GateError", "ConfigError", "TableRangeError", "DivergenceError")
WITHOUT = {"synthetic_flight/ensemble.py": 1}  # any exception that is no refusal has its type instead
CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+|more-faults|sites|motion|tracker")


def calls(path: Path) -> list[ast.Call]:
    tree = ast.parse(path.read_text())
    return [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name | ast.Attribute)]


def text(node: ast.expr) -> bool:
    """Words written on the spot, not a list of faults that have their codes."""
    return isinstance(node, ast.JoinedStr | ast.Constant) and not (isinstance(node, ast.Constant) and node.value == "")


def code_of(call: ast.Call, place: int) -> ast.expr | None:
    """Code by its name or its place; a span handed over with a star holds two places."""
    args = [arg for given in call.args for arg in ([given, given] if isinstance(given, ast.Starred) else [given])]
    named = {k.arg: k.value for k in call.keywords}.get("code")
    return named or (args[place] if len(args) > place else None)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_refusals_and_findings_have_codes(path: Path):
    without = []
    for call in calls(path):
        name = call.func.id if isinstance(call.func, ast.Name) else call.func.attr
        if name in (*REFUSALS, "Issue", "refuse", "refuse_config"):
            code = code_of(call, 1)
            empty = call.args and isinstance(call.args[0], ast.Constant) and call.args[0].value == ""
            if code is None and call.args and (text(call.args[0]) or (name == "Issue" and not empty)):
                without.append(call.lineno)
        elif name == "append" and "faults" in ast.unparse(call.func):
            assert not text(call.args[0]), f"{path.name}:{call.lineno}: a fault without a code"
            continue
        else:
            continue
        if isinstance(code, ast.Constant) and code.value:  # without one that of the words is kept
            assert CODE.fullmatch(code.value), f"{path.name}:{call.lineno}: {code.value}"
    assert len(without) == WITHOUT.get(str(path.relative_to(ROOT)), 0), f"{path.name}: {without}"
