"""The explorer: a page in the browser that shows batches, draws charts and answers SQL, and its server on this machine."""
