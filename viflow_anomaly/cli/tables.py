"""Tables of text on the console."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

    from viflow_anomaly.evaluation.flow_tables import Table


WIDTH_WITHOUT_TERMINAL = 200
"""Characters a line; rich's own default of 80 would cut most of the figures off."""


def rich_table(table: Table) -> RichTable:
    """A table that rich can print; its first column is never folded."""
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Column
    from rich.table import Table as RichTable

    columns = [
        Column(head, justify="left" if k < table.text_columns else "right", no_wrap=k == 0)
        for k, head in enumerate(table.heads)
    ]
    shown = RichTable(*columns, box=SIMPLE, title=escape(table.title), title_justify="left", padding=(0, 1, 0, 0))
    for row in table.rows:
        shown.add_row(*map(escape, row))
    return shown


def report_console() -> Console:
    """For tables of many columns: as wide as the terminal, and wide enough for all of them into a file or a pipe."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=WIDTH_WITHOUT_TERMINAL)
