"""Extensions: parts of SIERRA that the rest does not know. Each folder here can be deleted: see `sierra.config.extensions`."""
