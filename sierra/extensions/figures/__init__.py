"""Kinds of figures that fewer studies need: of classifiers, ranks, survival, networks, embeddings, ridges and Pareto fronts."""

from sierra.deliverables import matplotlib_import

matplotlib_import.prepare()
