"""What does a column's name mean? Header vocabulary in English and German: quantities, axes, units however written.

The words are in ``header_words.toml``.

A name is folded (lower case, no umlauts or raised digits), its unit split off, the rest cut into tokens; a quantity is
recognised where a token is in its vocabulary, whole or cut short. What the vocabulary leaves open (``G`` is g or gauss)
stays open here: `postflight.intake.column_recognition` decides by the numbers, or asks.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from importlib.resources import files

from flightmodel.units import UNITS, read_unit

_FOLD = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "µ": "u", "μ": "u", "²": "2", "³": "3", "⁻": "-"}
    | dict.fromkeys("·^*", "")
)
_WORDS = tomllib.loads((files("postflight.intake") / "header_words.toml").read_text(encoding="utf-8"))
# spelling -> units in flight.toml; several where the quantity decides
UNIT_SPELLINGS: dict[str, tuple[str, ...]] = {name: (name,) for name in UNITS if name != "1"}
for _unit, _written in _WORDS["units"].items():
    for _spelling in _written.split():
        UNIT_SPELLINGS[_spelling] = (*UNIT_SPELLINGS.get(_spelling, ()), _unit)
_AFTER_TEMPERATURE = {"f", "r", "c"}  # elsewhere these letters at a name's end are a force, an axis, anything
SEVERAL_MEANINGS = {"rps": "rad/s or revolutions a second"}


def _vocabulary(table: str) -> dict[str, set[str]]:
    return {meaning: set(words.split()) for meaning, words in _WORDS[table].items()}


QUANTITIES, VECTORS, MARKS = _vocabulary("quantities"), _vocabulary("vectors"), _vocabulary("marks")
BODY_RATES, NED = (set(" ".join(_WORDS["axes"][family]).split()) for family in ("body", "ned"))
AXES = {word: axis for family in _WORDS["axes"].values() for axis, words in enumerate(family) for word in words.split()}
_EVERY_TOKEN = {token for tokens in (*QUANTITIES.values(), *VECTORS.values(), AXES) for token in tokens}


@dataclass(frozen=True)
class ColumnName:
    """Parsed column name: tokens of its meaning, and the unit's text if it names one."""

    name: str
    tokens: tuple[str, ...]
    unit_text: str

    @property
    def _stated(self) -> tuple[str, ...]:
        """Units that the stated text may mean, as flight.toml takes them; none if it is not known."""
        key = unit_key(self.unit_text)
        if key in UNIT_SPELLINGS or not key or key in SEVERAL_MEANINGS:
            return UNIT_SPELLINGS.get(key, ())
        known = not self.unit_text.startswith("-") and read_unit(self.unit_text) is not None
        return (self.unit_text,) if known else ()

    def units(self, kind: str) -> list[str]:
        """Return the stated unit's names in flight.toml that fit a kind of quantity; empty where none does."""
        return [u for u in self._stated if _kind(u) == kind]

    @property
    def kinds(self) -> set[str]:
        """Kinds of quantity that the stated unit allows; empty where none is stated."""
        return {_kind(u) for u in self._stated}

    @property
    def unknown_unit(self) -> str:
        """Text in place of a unit that is not a known unit; empty if there is none."""
        return "" if self._stated else self.unit_text


def _kind(unit: str) -> str:
    found = read_unit(unit)
    return "" if found is None else found.kind


def parse_column_name(name: str, unit_row: str = "") -> ColumnName:
    """Return tokens and unit of a column's name; a row of units below the header takes precedence over the name."""
    base, unit = name.strip(), ""
    bracket = re.match(r"^(.*?)\s*[(\[{<]\s*([^()\[\]{}<>]+?)\s*[)\]}>]\s*$", base)
    if bracket and bracket[1]:
        base, unit = bracket[1], bracket[2]
    else:
        for mark in re.finditer(r"[_\s/.,]+(?:in\s+)?", base):
            head, tail = base[: mark.start()], base[mark.end() :]
            if head and _is_suffix(head, unit_key(tail)):
                base, unit = head, tail
                break
    stated = unit_row.strip().strip("()[]{}<>") or unit
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", base)
    return ColumnName(name, tuple(re.findall(r"[a-z]+|\d+", fold(spaced))), stated)


def _is_suffix(head: str, key: str) -> bool:
    """Whether the end of a column's name, behind a mark, is a unit."""
    if key in _AFTER_TEMPERATURE:
        return bool(matching(tuple(re.findall(r"[a-z]+|\d+", fold(head))), QUANTITIES["temperature"] | {"td"}))
    return key in UNIT_SPELLINGS or key in SEVERAL_MEANINGS


def matching(tokens: tuple[str, ...], vocabulary: set[str]) -> set[str]:
    """Return the tokens in a vocabulary, whole or abbreviated (``azim``) if the short form is no token of its own."""
    cut = {t for t in tokens if len(t) >= 3 and t not in _EVERY_TOKEN}
    return set(tokens) & vocabulary | {t for t in cut if any(w.startswith(t) and len(w) >= 6 for w in vocabulary)}


def fold(text: str) -> str:
    """Return lower case without umlauts, Greek mu and raised digits."""
    return text.replace("°C", "degc").replace("°", "deg").lower().translate(_FOLD)


def unit_key(text: str) -> str:
    """Return a unit's text as `UNIT_SPELLINGS` has it."""
    return fold(text).replace(" ", "").strip("()[]{}<>.")
