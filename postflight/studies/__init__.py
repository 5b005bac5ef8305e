"""The seed paper's own studies of section III and Figure 1.3, one command each, beside the paper's numbers."""

from __future__ import annotations
