"""The platform of ARGoS 3."""
