"""Floor 4: one file per verb. Each holds the verb's run(), from artefacts on disk and a frozen config to an artefact on disk."""
