"""Which keys may a file hold? JSON Schema for editors, from the very models that read the files.

What a key means is taken from the comments of the templates that ``postflight init`` writes. The schema says less than
the reader: it knows types, bounds and names, not what goes together.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib.resources import files
from typing import Any

from pydantic import BaseModel

from flightmodel.aeroinput import Sidecar
from flightmodel.flightfile import FlightFile
from flightmodel.vehicle import VehicleFile
from synthetic_flight.scenarios import ScenarioFile

MODELS: dict[str, type[BaseModel]] = {
    "flight": FlightFile,
    "vehicle": VehicleFile,
    "scenario": ScenarioFile,
    "coefficients": Sidecar,
}
HEADER = re.compile(r"^(?:# )?\[\[?([\w.]+)\]\]?")
KEY = re.compile(r"^(?:# )?(\w+) = (.*?)\s+# (.*)$")


def template(kind: str) -> str:
    """Text of the template of a ``flight`` or a ``vehicle``."""
    return (files("postflight.intake") / "templates" / f"{kind}.toml").read_text(encoding="utf-8")


def template_keys(kind: str) -> Iterator[tuple[str, str, str, str]]:
    """Table, key, value as written and comment of each line of a template that names a key."""
    table = ""
    for line in template(kind).splitlines():
        if header := HEADER.match(line):
            table = header[1]
        elif key := KEY.match(line):
            yield table, key[1], key[2], key[3]


def schema(kind: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a file of this kind."""
    made = MODELS[kind].model_json_schema()
    made = {"$schema": "https://json-schema.org/draft/2020-12/schema", **made}
    if kind in ("flight", "vehicle"):
        for table, key, _, comment in template_keys(kind):
            place = _properties(made, table)
            if key in place:
                place[key] = {**place[key], "description": comment.removesuffix(", e.g.").removesuffix("e.g.")}
    return made


def schema_text(kind: str) -> str:
    """Return the schema as it is written to a file."""
    return json.dumps(schema(kind), indent=2) + "\n"


def _properties(made: dict[str, Any], table: str) -> dict[str, Any]:
    """Return the properties of the table that a dotted name reaches, through references, options and lists."""
    at = made
    for part in filter(None, table.split(".")):
        inner = at.get("properties", {}).get(part)
        if inner is None:
            inner = at.get("additionalProperties") or next(iter(at.get("patternProperties", {}).values()))
        at = _resolved(made, inner)
    own: dict[str, Any] = at.get("properties", {})
    return own


def _resolved(made: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    while True:
        if "$ref" in node:
            node = made["$defs"][node["$ref"].rsplit("/", 1)[1]]
        elif "anyOf" in node:
            node = next(n for n in node["anyOf"] if n.get("type") != "null")
        elif node.get("type") == "array" and "$ref" in node.get("items", {}):
            node = node["items"]
        else:
            return node
