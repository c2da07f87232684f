"""Small tools that know nothing of SIERRA: text, files, hashes, caches, signals, entry points."""
