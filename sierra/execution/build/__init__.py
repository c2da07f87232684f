"""Builds: the products of `[build]` are made from the source before runs use them.

A build has inputs (source, command, variables, image, compilers) and products (files that git ignores). It is executed if no
recorded build has these inputs, or if the products on disk are not those that it made. Only content decides, never a time.

The modules in the order of their use: `recipe` (the inputs, and the id that follows from them), `products` (files on disk),
`state` (whether to build, and why), `perform` (execute and record), `ready` (build for a plan), `recorded` (for a replay).
"""
