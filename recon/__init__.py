"""Finds the best estimated trajectory from radar, accelerometers and gyros; entry point: `recon.bet.reconstruct`."""
