"""The best-estimated trajectory from trackers, accelerometers and gyros; entry point: `recon.reconstruct`."""

from __future__ import annotations
