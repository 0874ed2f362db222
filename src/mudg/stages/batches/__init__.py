"""Batches: steps over long lists of driving logs, shared out among any number of workers on any number of machines.

    lists.py      the list: sources, names, settings of a line, shards
    plan.py       what is to be done: steps, their commands and keys
    folders.py    where everything of a batch lies, and what is done there
    claims.py     who does what: claims with a lease
    retries.py    what becomes of a failure, by exit code
    inputs.py     inputs from a store, on this machine
    children.py   the process of one step of one scene
    turns.py      steps beside each other on a machine, or alone
    work.py       a worker: claim, run, publish, record
    quality.py    bounds on results, facts about them, second runs that must give the same bytes
    review.py     results outside the bounds, for people to look at
    local.py      workers on this machine
    engines.py    workers elsewhere: Slurm, Ray, and any scheduler that numbers its tasks
    listed.py     ``mudg ingest|annotate|fuse --list``
    status.py     how far a batch is; costs.py: what it took

All state lies in the output location, none in an engine. Nothing here imports a verb: steps are commands.
"""
