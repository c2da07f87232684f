"""Readers of NumPy arrays, Arrow files, SQLite databases, GraphML, HDF5 and NetCDF."""
