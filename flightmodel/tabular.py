"""How results show themselves: one line in a terminal, a table in a notebook, a DataFrame with units in its columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

SHOWN_ROWS, SHOWN_COLUMNS = 12, 20


class Tabular:
    """Base of results: subclasses give their data (`to_frame`) and one line about them (``_about``).

    A dataclass that derives from it is made with ``repr=False``.
    """

    def to_frame(self) -> pd.DataFrame:
        """Return the data as a table; a column's name ends in its unit (``theta_deg``, ``t_s``)."""
        raise NotImplementedError

    def _about(self) -> str:
        """One line: the content, its size and its time span."""
        return f"{len(self.to_frame())} rows"

    def __repr__(self) -> str:
        """Name of the type, and one line about it."""
        return f"<{type(self).__name__}: {self._about()}>"

    def _repr_html_(self) -> str:
        """Return a table for a notebook, with the line as its caption."""
        from html import escape

        table = self.to_frame().to_html(
            max_rows=SHOWN_ROWS, max_cols=SHOWN_COLUMNS, index=False, border=0, float_format=lambda x: f"{x:.6g}"
        )
        caption = f"<p><b>{type(self).__name__}</b>: {escape(self._about())}</p>"
        return f'{caption}<div style="overflow-x: auto">{table}</div>'
