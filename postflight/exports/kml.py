"""KML 2.2 for a globe: the track with its times (gx:Track), the same as a line, and the events as points.

KML heights are above sea level, the trajectory's above the WGS-84 ellipsoid; they are written as they are, and the
file's description says so.
"""

from __future__ import annotations

from xml.sax.saxutils import escape

import numpy as np

from postflight.exports.source import Source

STEP_S = 0.5  # between points


def kml_bytes(source: Source) -> bytes:
    """Return one .kml file."""
    table = source.trajectory
    t = table["t_s"].to_numpy()
    keep = np.flatnonzero(np.diff(np.floor((t - t[0]) / STEP_S + 1e-9), prepend=-1.0) > 0.0)
    keep = np.unique(np.append(keep, len(t) - 1))
    place = table[["lon_deg", "lat_deg", "alt_m"]].to_numpy()
    words = (
        f"{source.title}; {source.header['point']}. Heights are above the WGS-84 ellipsoid, drawn as above sea level: "
        "up to 107 m apart."
    )
    whens = "".join(f"<when>{source.utc(t[k])}Z</when>\n" for k in keep)
    track = "".join(f"<gx:coord>{' '.join(f'{v:.9g}' for v in place[k])}</gx:coord>\n" for k in keep)
    line = "\n".join(",".join(f"{v:.9g}" for v in place[k]) for k in keep)
    points = ""
    for event in source.events.itertuples(index=False):
        at = ",".join(f"{np.interp(event.t_s, t, c):.9g}" for c in place.T)
        points += (
            f"<Placemark><name>{escape(_printable(str(event.event)))}</name><TimeStamp><when>{source.utc(event.t_s)}Z"
            f"</when></TimeStamp><Point><altitudeMode>absolute</altitudeMode><coordinates>{at}</coordinates></Point>"
            "</Placemark>\n"
        )
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document>
<name>{escape(_printable(source.name))}</name>
<description>{escape(_printable(words))}</description>
<Style id="flight"><LineStyle><color>ff0080ff</color><width>2</width></LineStyle></Style>
<Placemark><name>track</name><styleUrl>#flight</styleUrl><gx:Track><altitudeMode>absolute</altitudeMode>
{whens}{track}</gx:Track></Placemark>
<Placemark><name>line</name><styleUrl>#flight</styleUrl><LineString><altitudeMode>absolute</altitudeMode><coordinates>
{line}
</coordinates></LineString></Placemark>
<Folder><name>events</name>
{points}</Folder>
</Document>
</kml>
"""
    return text.encode()


def _printable(text: str) -> str:
    """Text without characters that XML has no place for."""
    return "".join(c if c.isprintable() else " " for c in text)
