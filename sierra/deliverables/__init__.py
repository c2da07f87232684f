"""Deliverables: figures for people, made from the store."""
