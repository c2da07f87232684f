"""The folder of a paper: the files of all deliverables that are bound to queries, under names that stay."""
