"""Parts of a package: each is a function that makes some of its members."""
