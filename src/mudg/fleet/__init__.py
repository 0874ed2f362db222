"""Batches: steps over long lists of driving logs. Who runs them is an engine's matter; a scene run twice does only what
is missing.

    plan.py       the list, its shards, the steps, their commands and content keys
    records.py    what lies where in the output, and who drives the batch
    engines.py    threads of this process, Ray, Slurm
    work.py       a scene: make, publish, put on record, try again
    child.py      the process of a step
    inputs.py     inputs from a store, on this machine
    status.py     how far a batch is, and what it took
    listed.py     ``mudg ingest|annotate|fuse --list``

Nothing here imports a verb: steps are commands.
"""
