"""Which stable codes does the program print, what does each message say, and what is to be done?

Read from the source: every call that makes a refusal, a finding or a consistency check with a code, and every other
text that looks like a code and is not among `NO_CODES`: one that comes by way of a variable. Values and names in a
message are shown as dots. A remedy is the advice of a consistency check or the clause of a message that begins with an
instruction; ``docs/remedies.csv`` has those of the codes whose message has none, and no others. ``python
docs/message_codes.py`` prints the page.
"""

import ast
import csv
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
A_CODE = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
OPEN = "..."
# a message's clause that begins with one of these says what to do
INSTRUCTION = re.compile(
    r"(?:^|[:;,.?] (?:or |and |else |then |so |otherwise )?)((?:"
    "add|allow|calibrate|change|check|choose|close|compare|convert|copy|correct|cut|declare|deinterlace|delete|deliver|"
    "extract|fill|fit|fix|give|install|inspect|keep|leave|list|load|lower|make|mask|mend|move|name|note|put|raise|read|"
    "remove|rename|repeat|replace|restore|run|save|say|set|shorten|sort|split|start|state|swap|tabulate|take|transform|"
    "try|unpack|use|widen|write) .*)",
    re.IGNORECASE,
)
# of a call: which argument is the code, which the words
CALLS = {
    **dict.fromkeys(("GateError", "ConfigError", "DivergenceError", "TableRangeError"), (1, 0)),
    **dict.fromkeys(("Issue", "refuse", "refuse_config", "NoFitError", "__init__"), (1, 0)),
    **dict.fromkeys(("line", "_line"), (2, 1)),
    "data_sheet_check": (0, 8),
    "Hypothesis": (0, 1),
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


@cache
def _messages() -> tuple[dict[str, str], dict[str, str]]:
    """Words of every code, and the advice that a consistency check adds to them: of several, the longest known."""
    out: dict[str, str] = {}
    by_name: dict[str, str] = {}
    advised: dict[str, str] = {}
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
            for each in codes_of(code, known):
                out[each] = max(out.get(each, ""), _joined(words, known), key=said)
                if "advice" in given:
                    advised[each] = max(advised.get(each, ""), _joined(given["advice"], known), key=said)
    return dict(sorted((by_name | out).items())), advised


def _joined(words: ast.expr, known: Known) -> str:
    return " ".join(re.sub(r"(\.\.\.[ ,;:']*){2,}", f"{OPEN} ", words_of(words, known)).split())


def message_codes() -> dict[str, str]:
    """Words of every code; of several messages with one code, the one of which most is known."""
    return _messages()[0]


def remedies() -> dict[str, str]:
    """What to do about every code: the program's own words, else those of ``docs/remedies.csv``."""
    return unsaid() | said_by_the_program()


def said_by_the_program() -> dict[str, str]:
    """Remedies that stand in the messages: a check's advice, or the clause that begins with an instruction."""
    words, advised = _messages()
    found = {code: match[1] for code, text in words.items() if (match := INSTRUCTION.search(text))}
    return found | {code: text for code, text in advised.items() if said(text) > 10}


def unsaid() -> dict[str, str]:
    """Remedies of the codes whose message has none, from ``docs/remedies.csv``."""
    with (Path(__file__).parent / "remedies.csv").open(encoding="utf-8", newline="") as lines:
        return {row["code"]: row["what_to_do"] for row in csv.DictReader(lines)}


def page() -> str:
    """The page of all codes."""
    todo = remedies()
    rows = [
        f"| `{code}` | {_cell(text, todo[code])} | {_sentence(todo[code])} |" for code, text in message_codes().items()
    ]
    head = (
        "# Message codes\n\nThis page lists every refusal, finding and consistency check with its stable code, its "
        f"message, and its cause or remedy. `{OPEN}` stands for a name, place or value of the case at hand. The page "
        "is made from the source.\n\n| code | message | cause or remedy |\n|---|---|---|\n"
    )
    return head + "\n".join(rows) + "\n"


def _cell(text: str, remedy: str) -> str:
    """A message without markup and without the remedy, which the next cell has."""
    return _shown(re.sub(r"\[/?(?:red|yellow|green)?\]", "", text).removesuffix(remedy).rstrip(" :;,.")) or OPEN


def _sentence(text: str) -> str:
    return _shown(text[:1].upper() + text[1:].rstrip(".")) + "."


def _shown(text: str) -> str:
    return text.replace("|", "/").replace("<", "&lt;")


if __name__ == "__main__":
    print(page())  # noqa: T201
