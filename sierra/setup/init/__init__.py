"""`sierra init`: write a first sierra.toml from the content of a folder."""
