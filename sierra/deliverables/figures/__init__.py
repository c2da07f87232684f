"""Figures for a two-column paper."""
