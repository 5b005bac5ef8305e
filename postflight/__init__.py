"""Where the parts meet: the command, the pipeline, results, scores and figures."""

from __future__ import annotations
