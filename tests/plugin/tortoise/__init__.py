"""Plug-ins for SIERRA, one of each kind, around a simulator of tortoises."""
