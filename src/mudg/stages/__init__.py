"""The verbs: each is a module with a ``run()``, from files on disk and a frozen configuration to files on disk.

The other modules (``batch``, ``score_truth``) and the folders hold what one or
several verbs need.
"""
