"""`sierra init`: write a first sierra.toml from what a folder holds."""
