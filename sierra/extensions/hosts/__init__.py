"""Hosts that are reached over SSH: links to them, and `sierra doctor --hosts`."""
