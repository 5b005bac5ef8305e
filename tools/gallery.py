"""Draws the pictures of docs/figures.md: its calls are executed beside a flight called demo-flight.

``make demo`` flies the flight; ``python tools/gallery.py`` then writes ``docs/images/gallery/``. A picture that follows
a block of Python is the value of ``figure`` after it.
"""

import contextlib
import re
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import postflight as pf

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "figures.md"
BLOCK = re.compile(r"^```python\n(.*?)^```\n+(?:!\[[^\]]*\]\((\S+)\))?", re.DOTALL | re.MULTILINE)


def main():
    scope = {}
    with TemporaryDirectory() as folder:
        (Path(folder) / "demo-flight").symlink_to(ROOT / "demo-flight", target_is_directory=True)
        with contextlib.chdir(folder):
            for code, picture in BLOCK.findall(PAGE.read_text()):
                exec(code, scope)
                if picture:
                    write(scope["figure"], PAGE.parent / picture)


def write(figure, path):
    """Save a figure with a palette of 256 colours: less than half of the bytes, which the repository keeps for ever."""
    path.parent.mkdir(exist_ok=True)
    pf.plots.save(figure, path)
    Image.open(path).convert("RGB").quantize(method=Image.Quantize.FASTOCTREE).save(path, optimize=True)


if __name__ == "__main__":
    main()
