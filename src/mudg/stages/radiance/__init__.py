"""Parts of ``fit`` and ``render`` for radiance fields (method emernerf)."""
