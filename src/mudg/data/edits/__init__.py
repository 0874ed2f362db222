"""Edit scripts: YAML files that say how a drive is to be changed (``docs/edit.md``). Read by ``script.py``, verbs in ``records.py``."""

from mudg.data.edits.records import EGO
from mudg.data.edits.script import EditScript, ScriptEdit, parse_edits, read_edits

__all__ = ["EGO", "EditScript", "ScriptEdit", "parse_edits", "read_edits"]
