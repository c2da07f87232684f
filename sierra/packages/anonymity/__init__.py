"""Anonymous packages: rewritten records, and a search for words that show who made them."""
