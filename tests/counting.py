"""What the budget counts of each package: lines of code, files, constants at module level, codes of messages.

A *line of code* holds a token other than a comment, a docstring or an import. A *constant* is a name in capitals that
a module binds to an expression with a number in it. A *code* is a stable code of a message
(``docs/message_codes.py``); it belongs to the first package, in the order of `PACKAGES`, that uses it.

``python -m tests.counting`` prints the counts beside ``budget.toml``.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
KINDS = ("code_lines", "files", "constants", "codes")
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip


def lines_of(node: ast.stmt) -> range:
    """Lines that a statement covers."""
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def is_docstring(node: ast.stmt) -> bool:
    """Whether a statement is a text alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def code_lines(source: str) -> int:
    """Lines of code of a module."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            left_out.update(lines_of(node))
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body and is_docstring(node.body[0]):
            left_out.update(lines_of(node.body[0]))
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            held.update(range(token.start[0], token.end[0] + 1))
    return len(held - left_out)


def holds_number(node: ast.expr) -> bool:
    """Whether a number stands in an expression."""
    found = (n.value for n in ast.walk(node) if isinstance(n, ast.Constant))
    return any(isinstance(value, int | float | complex) and not isinstance(value, bool) for value in found)


def constants(source: str) -> int:
    """Constants of a module; each name of a tuple counts."""
    count = 0
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target, value = node.targets[0] if isinstance(node, ast.Assign) else node.target, node.value
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        each = isinstance(value, ast.Tuple) and len(value.elts) == len(names) > 1
        values = value.elts if each and isinstance(value, ast.Tuple) else [value] * len(names)
        pairs = zip(names, values, strict=True)
        count += sum(isinstance(n, ast.Name) and n.id == n.id.upper() and holds_number(v) for n, v in pairs)
    return count


def counted() -> dict[str, dict[str, int]]:
    """Counts of each package."""
    sys.path.insert(0, str(ROOT / "docs"))
    from message_codes import message_codes

    codes = set(message_codes())
    out: dict[str, dict[str, int]] = {}
    for package in PACKAGES:
        sources = [path.read_text(encoding="utf-8") for path in sorted((ROOT / package).rglob("*.py"))]
        own = {code for code in codes if any(f'"{code}"' in source for source in sources)}
        codes -= own
        numbers = (sum(map(code_lines, sources)), len(sources), sum(map(constants, sources)), len(own))
        out[package] = dict(zip(KINDS, numbers, strict=True))
    return out


def budget() -> dict[str, dict[str, int]]:
    """Counts that ``budget.toml`` allows."""
    return tomllib.loads((ROOT / "budget.toml").read_text(encoding="utf-8"))["package"]


def main() -> None:
    """Print counts and budget."""
    found, allowed = counted(), budget()
    for counts in (found, allowed):
        counts["all"] = {kind: sum(of[kind] for of in counts.values()) for kind in KINDS}
    rows = [f"{'':18}" + "".join(f"{kind:>22}" for kind in KINDS)]
    for name in (*PACKAGES, "all"):
        rows.append(f"{name:18}" + "".join(f"{found[name][k]:>12} of {allowed[name][k]:>6}" for k in KINDS))
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
