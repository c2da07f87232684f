"""Settings: `sierra.toml`, and the user's own defaults."""
