"""The description of a package as a Provenance Run Crate."""
