"""Small tools that do not depend on the rest of SIERRA: text, files, hashes, caches, signals, entry points."""
