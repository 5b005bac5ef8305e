"""MATLAB (version 5): structures ``trajectory``, ``deflection.<method>`` and ``about``, a column vector a column."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd

from postflight.exports.source import Source

HEADER = b"MATLAB 5.0 MAT-file, postflight export"  # scipy writes the time of writing there


def mat_bytes(source: Source) -> bytes:
    """Return one .mat file; names longer than MATLAB's 63 letters do not occur."""
    from scipy.io import savemat

    content = {
        "trajectory": _struct(source.trajectory),
        "deflection": {method: _struct(table) for method, table in source.deflections.items()},
        "covariance": {"t_s": source.covariance_time_s[:, None], "position_velocity_rotation": source.covariance},
        "about": {
            "title": source.title,
            "run": source.run,
            "epoch_utc": source.utc(0.0) + "Z",
            "point": source.header["point"],
            "synthetic": source.synthetic,
        },
    }
    if not source.deflections:
        del content["deflection"]
    out = io.BytesIO()
    savemat(out, content, long_field_names=True, oned_as="column", do_compression=True)
    return HEADER.ljust(116) + out.getvalue()[116:]


def _struct(table: pd.DataFrame) -> dict[str, np.ndarray]:
    return {name: table[name].to_numpy(dtype=float)[:, None] for name in table.columns}
