"""Conformance suites: what every plug-in must hold to, for the tests of its author."""
