"""A bench to work at a film by hand: `postflight camera FOLDER`."""
