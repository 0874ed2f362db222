"""Writers of formats that other programs read. One literal table: format name -> module that holds the writer."""

from __future__ import annotations

from typing import Final

EXPORTERS: Final[dict[str, str]] = {"mp4": "mudg.data.exporters.video"}
"""Format -> module (named for people and tables; never imported from a string)."""
