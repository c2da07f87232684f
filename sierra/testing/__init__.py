"""Conformance suites: the contracts of plug-ins as functions that a plug-in's author calls in tests."""
