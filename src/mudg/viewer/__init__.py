"""Pages of results: reports, galleries, the viewer, its server."""
