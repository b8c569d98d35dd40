"""Shared code of the tests: scenes, simulated histories, findings."""
