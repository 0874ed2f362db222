"""Parts of the verb adapt."""
