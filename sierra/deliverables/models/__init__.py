"""Models: predictions that are drawn with the data of a batch, and how far the data are from them."""
