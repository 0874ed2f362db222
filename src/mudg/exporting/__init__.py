"""Fitted scenes and their logs as files of other programs."""
