"""Camera bench for reviewing a film by hand: `postflight camera FOLDER`."""
