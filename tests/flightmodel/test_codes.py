"""Every refusal and finding of the gate has a short stable code, which scripts and tests use instead of its words."""

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "flightmodel"
REFUSALS = ("GateError", "ConfigError", "TableRangeError", "DivergenceError", "Finding", "Fault")
CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)+|more-faults")


def calls(path: Path) -> list[ast.Call]:
    tree = ast.parse(path.read_text())
    return [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name | ast.Attribute)]


def text(node: ast.expr) -> bool:
    """Words written on the spot, not a list of faults that have their codes."""
    return isinstance(node, ast.JoinedStr | ast.Constant) and not (isinstance(node, ast.Constant) and node.value == "")


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("*.py")), ids=lambda p: p.name)
def test_refusals_and_findings_have_codes(path: Path):
    for call in calls(path):
        name = call.func.id if isinstance(call.func, ast.Name) else call.func.attr
        code = {k.arg: k.value for k in call.keywords}.get("code")
        if name == "Finding":
            code = code or (call.args[4] if len(call.args) > 4 else None)
            assert code is not None, f"{path.name}:{call.lineno}"
        elif name in (*REFUSALS, "refuse", "refuse_config"):
            code = code or (call.args[1] if len(call.args) > 1 else None)
            assert code is not None or not call.args or not text(call.args[0]), f"{path.name}:{call.lineno}"
        elif name == "append" and "faults" in ast.unparse(call.func):
            assert not text(call.args[0]), f"{path.name}:{call.lineno}: a fault without a code"
            continue
        else:
            continue
        if isinstance(code, ast.Constant):
            assert CODE.fullmatch(code.value), f"{path.name}:{call.lineno}: {code.value}"
