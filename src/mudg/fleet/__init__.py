"""Batches: steps over long lists of driving logs. Who runs them is an engine's matter; a scene run twice does only what
is missing. Nothing here imports a verb: steps are commands."""
