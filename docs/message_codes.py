"""Which stable codes does the program print, and what does each message say?

Read from the source: every call that makes a refusal, a finding or a consistency check with a code, and every other
text that looks like a code and is not among `NO_CODES`: one that comes by way of a variable. Values and names in a
message are shown as dots. ``python docs/message_codes.py`` prints the page.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
A_CODE = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
OPEN = "..."
# of a call: which argument is the code, which the words
CALLS = {
    **dict.fromkeys(("GateError", "ConfigError", "DivergenceError", "TableRangeError"), (1, 0)),
    **dict.fromkeys(("Issue", "refuse", "refuse_config", "NoFitError", "__init__"), (1, 0)),
    **dict.fromkeys(("line", "_line"), (2, 1)),
    "data_sheet_check": (0, 8),
    "Single": (0, 1),
    "_of_either": (0, 1),
    **dict.fromkeys(("Check", "Check.of"), (0, 6)),
}
# words with a hyphen that are none: encodings, headers of a page, commands and their folders, units, parts of words,
# effects that `postflight.systematic_differences` names
NO_CODES = {
    "utf-8", "utf-8-sig", "utf-16", "latin-1", "no-referrer", "no-store", "same-origin", "retry-failed",
    "shell-test", "demo-flight", "study-damping", "study-stiffness", "study-preflight", "study-shell-test",
    "non-orthogonality", "wind-relative", "time-offset", "track-rotation", "attitude-body",
    "attitude-earth", "inertial-velocity", "other-point",
}  # fmt: skip
Known = dict[str, ast.expr]


def words_of(node: ast.expr, known: Known) -> str:
    """Text of an expression, as far as it stands in the source."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(words_of(part, known) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return words_of(node.value, known)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return words_of(node.left, known) + words_of(node.right, known)
    if isinstance(node, ast.IfExp):
        return max(words_of(node.body, known), words_of(node.orelse, known), key=said)
    if isinstance(node, ast.List | ast.Tuple) and node.elts:
        return max((words_of(each, known) for each in node.elts), key=said)
    if isinstance(node, ast.ListComp):
        return words_of(node.elt, known)
    if isinstance(node, ast.Name) and node.id in known:
        return words_of(known[node.id], {name: value for name, value in known.items() if name != node.id})
    return OPEN


def said(text: str) -> int:
    """How many letters of a text are known."""
    return len(re.findall(r"[a-zA-Z]", text))


def codes_of(node: ast.expr, known: Known) -> list[str]:
    """Codes that an expression may be."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and A_CODE.fullmatch(node.value):
        return [node.value]
    if isinstance(node, ast.IfExp):
        return codes_of(node.body, known) + codes_of(node.orelse, known)
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "getattr" and len(node.args) == 3:
        return codes_of(node.args[2], known)
    if isinstance(node, ast.Name) and node.id in known:
        return codes_of(known[node.id], {name: value for name, value in known.items() if name != node.id})
    return []


def assigned(scope: ast.AST) -> list[tuple[int, str, ast.expr]]:
    """Names that a function or a module gives to expressions: line, name, expression."""
    found = []
    for node in ast.walk(scope):
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            if isinstance(target, ast.Name):
                found.append((node.lineno, target.id, value))
            elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = zip(target.elts, value.elts, strict=False)
                found += [(node.lineno, name.id, each) for name, each in pairs if isinstance(name, ast.Name)]
    return sorted(found, key=lambda each: each[0])


def calls(tree: ast.Module) -> list[tuple[ast.Call, Known]]:
    """Every call of a module, with what the names stand for there: the last before it."""
    out: dict[ast.Call, Known] = {}
    above = {name: value for node in tree.body for _, name, value in assigned(node) if isinstance(node, ast.Assign)}
    for scope in (tree, *(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))):  # outside to inside
        names = [] if scope is tree else assigned(scope)
        for node in ast.walk(scope):
            if isinstance(node, ast.Call):
                out[node] = above | {name: value for line, name, value in names if line <= node.lineno}
    return list(out.items())


def codes_by_name(tree: ast.Module) -> dict[str, str]:
    """Texts of a module that look like codes of two words or more, each with the longest text in its own expression."""
    above = {child: parent for parent in ast.walk(tree) for child in ast.iter_child_nodes(parent)}
    out = {}
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Constant) and isinstance(node.value, str) and "-" in node.value):
            continue
        if not A_CODE.fullmatch(node.value) or node.value in NO_CODES or isinstance(above[node], ast.Expr):
            continue
        around: ast.AST = node
        beside: list[str] = []
        while not beside and not isinstance(around, ast.stmt):
            around = above[around]
            near = [part for part in ast.iter_child_nodes(around) if isinstance(part, ast.expr)]
            beside = [text for part in near if " " in (text := words_of(part, {}))]
        out[node.value] = max(beside, default="", key=said)
    return out


def message_codes() -> dict[str, str]:
    """Words of every code; of several messages with one code, the one of which most is known."""
    out: dict[str, str] = {}
    by_name: dict[str, str] = {}
    for path in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for code, text in codes_by_name(tree).items():
            by_name[code] = max(by_name.get(code, ""), " ".join(text.split()), key=said)
        for call, known in calls(tree):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            name = ast.unparse(call.func) if name == "of" else name
            at_code, at_words = CALLS.get(name, (-1, -1))
            spread = [arg for arg in call.args for arg in [arg] * (1 + isinstance(arg, ast.Starred))]  # of two: a span
            given = dict(enumerate(spread)) | {word.arg: word.value for word in call.keywords}
            code, words = given.get("code", given.get(at_code)), given.get(at_words, given.get("words", given.get(1)))
            if name not in CALLS or code is None or words is None:
                continue
            text = " ".join(re.sub(r"(\.\.\.[ ,;:']*){2,}", f"{OPEN} ", words_of(words, known)).split())
            for each in codes_of(code, known):
                out[each] = max(out.get(each, ""), text, key=said)
    return dict(sorted((by_name | out).items()))


def page() -> str:
    """The page of all codes."""
    rows = [
        f"| `{code}` | {(text or OPEN).replace('|', '/').replace('<', '&lt;')} |"
        for code, text in message_codes().items()
    ]
    head = (
        "# Message codes\n\nEvery refusal, finding and consistency check: its stable code, and what its message says "
        f"(`{OPEN}`: a name, place or value of the case at hand). Made from the source.\n\n"
        "| code | message |\n|---|---|\n"
    )
    return head + "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(page())  # noqa: T201
