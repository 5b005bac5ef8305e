"""CCSDS Orbit Ephemeris Message 2.0 (KVN): places and velocities Earth-fixed, covariances once a second.

References
----------
CCSDS 502.0-B-2, Orbit Data Messages, 2009. WGS-84 (G1150 and later) and ITRF2000 agree to centimetres.
"""

from __future__ import annotations

from postflight.exports.source import Source

FRAME = "ITRF2000"
PLACE = ["rx_ecef_m", "ry_ecef_m", "rz_ecef_m", "vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]


def oem_bytes(source: Source) -> bytes:
    """Return one .oem file: km, km/s, km^2."""
    table = source.trajectory
    t = table["t_s"].to_numpy()
    state = table[PLACE].to_numpy() / 1000.0
    name = "".join(c if c.isalnum() and c.isascii() else "_" for c in source.name) or "flight"
    lines = [
        "CCSDS_OEM_VERS = 2.0",
        "COMMENT " + _ascii(source.title),
        f"COMMENT point: {_ascii(source.header['point'])}",
        f"CREATION_DATE = {source.finished_utc[:19]}",
        "ORIGINATOR = POSTFLIGHT",
        "",
        "META_START",
        f"OBJECT_NAME = {name}",
        f"OBJECT_ID = {source.epoch:%Y}-000A",
        "CENTER_NAME = EARTH",
        f"REF_FRAME = {FRAME}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {source.utc(t[0])}",
        f"STOP_TIME = {source.utc(t[-1])}",
        "INTERPOLATION = HERMITE",
        "INTERPOLATION_DEGREE = 3",
        "META_STOP",
        "",
    ]
    lines += [f"{source.utc(at)} {' '.join(f'{v:.9f}' for v in row)}" for at, row in zip(t, state, strict=True)]
    lines += ["", "COVARIANCE_START"]
    for at, covariance in zip(source.covariance_time_s, source.covariance[:, :6, :6] / 1e6, strict=True):
        lines += [f"EPOCH = {source.utc(at)}", f"COV_REF_FRAME = {FRAME}"]
        lines += [" ".join(f"{v:.9e}" for v in covariance[k, : k + 1]) for k in range(6)]
    return ("\n".join([*lines, "COVARIANCE_STOP"]) + "\n").encode()


def _ascii(text: str) -> str:
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
