"""Which columns of a table are another team's trajectory: accelerations, rates, flow, Mach number, pressure, altitude?

The header's words and units decide, as for the sensors of ``postflight import``; what they leave open is a fault with
the way to state it. `postflight.loads_table` makes loads of the columns, and ``postflight import`` proposes ``[loads]``
for a table that has them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from flightmodel.checks import FloatArray, Issue, nearest_name
from flightmodel.tables import to_si
from flightmodel.units import read_unit
from postflight.intake.column_recognition import (
    ASKED,
    NUMBERS,
    STATED,
    ColumnProposal,
    Recogniser,
    SourceProposal,
    column_unit,
)
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.headers import ColumnName


class _Meaning(NamedTuple):
    """Kind of a quantity, and the words of a header that mean it."""

    kind: str
    words: tuple[str, ...]


# the longer name first: "alpha total" is no alpha
_SCALARS = {
    "mach": _Meaning("fraction", ("mach", "machno", "machnumber", "ma")),
    "dynamic_pressure": _Meaning(
        "pressure", ("qbar", "dynamicpressure", "dynpressure", "dynp", "pdyn", "qdyn", "qinf", "q")
    ),
    "airspeed": _Meaning("speed", ("airspeed", "tas", "vtas", "vair", "vrel", "velocity", "speed", "v")),
    "altitude": _Meaning("length", ("altitude", "alt", "gdalt", "height", "h")),
    "alpha_total": _Meaning("angle", ("alphatotalwind", "alphatotal", "totalalpha", "alphat", "totalangleofattack")),
    "clock": _Meaning("angle", ("clocklv", "clock", "clockangle", "clockingangle")),
    "alpha": _Meaning("angle", ("alpha", "aoa", "angleofattack")),
    "beta": _Meaning("angle", ("beta", "sideslip", "aos", "angleofsideslip")),
    "v_north": _Meaning("speed", ("vnorth", "vn", "northvelocity", "velocitynorth", "velnorth", "veln")),
    "v_east": _Meaning("speed", ("veast", "ve", "eastvelocity", "velocityeast", "veleast", "vele")),
    "v_down": _Meaning("speed", ("vdown", "vd", "downvelocity", "velocitydown", "veldown", "veld")),
    "wind_north": _Meaning("speed", ("windnorth", "northwind", "windn", "vwindnorth", "vwn")),
    "wind_east": _Meaning("speed", ("windeast", "eastwind", "winde", "vwindeast", "vwe")),
    "yaw": _Meaning("angle", ("yaw", "psi", "heading")),
    "pitch": _Meaning("angle", ("pitch", "theta")),
    "roll": _Meaning("angle", ("roll", "phi", "bank")),
}
MOTION = ("v_north", "v_east", "v_down", "wind_north", "wind_east", "yaw", "pitch", "roll")
_WITH_SD = ("dynamic_pressure", "alpha", "beta", "alpha_total")
# columns of this program's own bet.csv that the recognition by words would not choose among several
OWN_COLUMNS = {
    "ax": "ax_cg_mps2", "ay": "ay_cg_mps2", "az": "az_cg_mps2",
    "p": "p_body_degps", "q": "q_body_degps", "r": "r_body_degps", "wind_sd": "wind_sd_mps",
}  # fmt: skip
FORCE, RATES = ("ax", "ay", "az"), ("p", "q", "r")
_TRIADS = {"sensors.accelerometer": FORCE, "sensors.rates": RATES}
_FLOWS = (("alpha", "beta"), ("alpha_total", "clock"), MOTION)
_AIR = {"mach", "dynamic_pressure", "airspeed"}


@dataclass
class FoundColumns:
    """Columns of a table by the short names of their quantities; open or contradictory ones are among the faults."""

    table: FreeFormTable
    found: dict[str, ColumnProposal] = field(default_factory=dict)
    faults: list[Issue] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    time_s: FloatArray | None = None  # where they were read from clock times

    def leave_open(self, short: str, words: str, code: str, column: str = "NAME") -> None:
        """Record the fault of a quantity's column, and how to state it."""
        how = f"state it, as columns={{'{short}': '{column}:UNIT'}}, --column {short}='{column}:UNIT' or in flight.toml"
        self.faults.append(Issue(f"{self.table.label}: {words}; {how}", code))

    def add(self, proposal: ColumnProposal) -> None:
        """Add a column; an unknown unit is a fault."""
        if self.found.setdefault(proposal.short, proposal) is proposal and not proposal.unit:
            words = f"column '{proposal.column}' ({proposal.short}): its unit of {kind_of(proposal.short)} is open"
            why = f" ({proposal.why})" if proposal.why else ""
            self.leave_open(proposal.short, f"{words}{why}", "unit-unknown", proposal.column)

    def values(self) -> dict[str, FloatArray]:
        """Columns (n,) in SI units."""
        at = self.table.names.index
        read = {short: to_si(self.table.numbers(at(m.column)).copy(), m.unit) for short, m in self.found.items()}
        return read if self.time_s is None else read | {"t": self.time_s.copy()}

    @property
    def missing(self) -> list[str]:
        """Required quantities of loads that have no column."""
        there = set(self.found) | (set() if self.time_s is None else {"t"})
        if there >= set(MOTION):
            there.add("airspeed")
        out = [name for name in ("t", *FORCE, *RATES, "altitude") if name not in there]
        if not any(set(names) <= there for names in _FLOWS):
            motion = ", ".join(name for name in MOTION if name not in there) if {"v_north", "yaw"} <= there else ""
            out.append("clock" if "alpha_total" in there else motion or "alpha and beta")
        return out if len(_AIR & there) >= 2 else [*out, "two of mach, dynamic_pressure and airspeed"]


def kind_of(short: str) -> str:
    """Kind of a quantity by its short name."""
    base = short.removesuffix("_sd")
    if base in _SCALARS:
        return _SCALARS[base].kind
    kinds = dict.fromkeys(FORCE, "acceleration") | dict.fromkeys(RATES, "rate") | {"t": "time"}
    return kinds.get(base, "speed")


def find_columns(table: FreeFormTable, chosen: dict[str, str], time_s: FloatArray | None = None) -> FoundColumns:
    """Find every quantity that the table holds; ``chosen`` are stated columns, with units after a colon.

    ``time_s`` (n,) are its times where they are known.
    """
    out, recogniser = FoundColumns(table, time_s=time_s), Recogniser(table)
    known = {"t", *FORCE, *RATES, "wind_sd", *_SCALARS, *(f"{name}_sd" for name in _WITH_SD)}
    for short in sorted(set(chosen) - known):
        words = f"columns: no quantity '{short}'{nearest_name(short, known)}; known: {', '.join(sorted(known))}"
        out.faults.append(Issue(f"{table.label}: {words}", "key-unknown"))
    if time_s is not None and len(time_s) != len(table.rows):
        words = f"{len(table.rows)} rows and {len(time_s)} times; plain CSV is wanted, as postflight import writes it"
        out.faults.append(Issue(f"{table.label}: {words}", "time-format"))
    if "t" not in chosen and time_s is None:
        _find_time(recogniser, out)
    stated = {short: name for short, name in OWN_COLUMNS.items() if name in table.names} | chosen
    for short in known & set(stated):
        _take_stated(recogniser, short, stated[short], out)
    for source in recogniser.three_axis_sensors():
        if source.section in _TRIADS and not set(_TRIADS[source.section]) <= set(out.found):
            for proposal in source.columns:
                out.add(proposal)
    for short, meaning in _SCALARS.items():
        for name in (short, f"{short}_sd") if short in _WITH_SD else (short,):
            if name not in stated:
                _take_scalar(recogniser, name, meaning, out)
    out.unused = [table.names[k] for k in sorted(recogniser.free)]
    return out


def loads_proposal(table: FreeFormTable) -> tuple[SourceProposal, list[str]] | None:
    """``[loads]`` of a table with force, rates, a flow angle or winds, and air; with the columns that are not used.

    None for any other table, and for one with slant range, azimuth and elevation, which is a radar's.
    """
    recogniser, out = Recogniser(table), find_columns(table, {})
    recogniser.three_axis_sensors()
    there = set(out.found)
    flows = bool(there & {"alpha", "alpha_total"}) or {"v_north", "wind_north"} <= there
    air = len(_AIR & there) >= 2 or {"v_north", "wind_north"} <= there
    if not ({*FORCE, *RATES} <= there and flows and air) or recogniser.radar():
        return None
    columns = [m for short, m in out.found.items() if short != "t"]
    place = ("acceleration_at", '"cg"', "or a package of the vehicle file, or a place from the datum, m")
    source = SourceProposal("loads", columns, [place], recogniser.time)
    return source, out.unused


def _find_time(recogniser: Recogniser, out: FoundColumns) -> None:
    """Seconds in the table's own time column."""
    time = recogniser.time
    if time is None or time.format != "seconds":
        out.leave_open("t", "no column of seconds", "column-missing", "TIME")
    else:
        out.add(ColumnProposal("t", time.columns[0], time.unit, time.how, time.why))


def _take_stated(recogniser: Recogniser, short: str, text: str, out: FoundColumns) -> None:
    """Take a quantity whose column, with unit after a colon, is stated."""
    table, (name, _, unit) = recogniser.table, text.rpartition(":") if ":" in text else (text, "", "")
    if name not in table.names:
        words = f"{short}: no column '{name}'{nearest_name(name, table.names)}"
        out.faults.append(Issue(f"{table.label}: {words}", "column-missing"))
        out.found[short] = ColumnProposal(short, name, "", ASKED, "")
        return
    k, kind = table.names.index(name), kind_of(short)
    units = [unit] if unit else recogniser.named[k].units(kind) or (["1"] if kind == "fraction" else [])
    known = read_unit(units[0]) if units else None
    fits = known is not None and known.kind == kind
    out.add(ColumnProposal(short, name, units[0] if fits else "", STATED, ""))
    recogniser.free.discard(k)


def _take_scalar(recogniser: Recogniser, short: str, meaning: _Meaning, out: FoundColumns) -> None:
    """Find one quantity by its header words; the first word that matches a column decides."""
    wants_sd = short.endswith("_sd")
    fitting = [k for k in sorted(recogniser.free) if _is_sd(recogniser.named[k]) == wants_sd]
    for word in meaning.words:
        for k in fitting:
            named = recogniser.named[k]
            if _stem(named, short) != word or (named.kinds and meaning.kind not in named.kinds):
                continue
            unit, how, why = next(iter(named.units(meaning.kind)), ""), STATED, f"'{named.unit_text}' in the header"
            if not unit and meaning.kind == "fraction" and not named.kinds:
                unit, why = "1", "a ratio"
            elif not unit and not named.unknown_unit:
                unit, why = column_unit(short, meaning.kind, recogniser.table.numbers(k))
                how = NUMBERS if unit else ASKED
            out.add(ColumnProposal(short, recogniser.table.names[k], unit, how if unit else ASKED, why))
            recogniser.free.discard(k)
            return


def _stem(named: ColumnName, short: str) -> str:
    """Words of a name joined, without those for its frame or for a standard deviation."""
    said = {"sd", "sigma", "std", "deg", "body", "cg", "geodetic", "geometric"} | (
        set() if short.startswith("wind") else {"wind"}
    )
    return "".join(token for token in named.tokens if token not in said)


def _is_sd(named: ColumnName) -> bool:
    return bool({"sd", "sigma", "std"} & set(named.tokens))
