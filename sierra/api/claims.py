"""Claims of `sierra.toml`, their registrations and baselines."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from pathlib import Path

from sierra.api.noun import Noun
from sierra.api.packages import PACKAGED, batches_of_package
from sierra.deliverables.claims import baseline as baselines
from sierra.deliverables.claims import evaluate, registration, regression
from sierra.deliverables.claims.model import Evaluated
from sierra.errors import Missing, NotFound, UsageError
from sierra.store.store import Store


class Claims(Noun):
    """Claims of `sierra.toml`: `project.claims`."""

    def evaluate(self, *names: str) -> tuple[Evaluated, ...]:
        """Return whether the claims of `sierra.toml` hold on the recorded runs: all, or those with these names.

        Each has a `verdict`, its numbers as `text`, `n`, the `ground` of the verdict, and the word `registered`: `planned` or
        `exploratory`. Claims that are not registered yet are registered first, if the store can be written. p values are
        corrected for all claims of the project on the same table of pairs, also if only some are evaluated. A claim that cannot
        be evaluated is no error: its verdict is "can't tell". Raises NotFound for an unknown name, and if there are no claims.

        >>> project.claims.evaluate()
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        if self._project.config.claims and not self._project.folder.is_package:
            with contextlib.suppress(Missing):  # the words say what is not registered
                registration.register(self._loaded, Store.create(self._project.paths.store))
        return evaluate.evaluate(self._loaded, self._store, names)

    def register(self) -> registration.NewRegistrations:
        """Record the text of each claim of `sierra.toml` that is not recorded yet; evaluate none.

        A claim that is recorded before its runs are executed is planned. The result has the names of the `new` and the `known`
        claims, and the reasons why others are `refused`. Raises NotFound if there are no claims, Missing if the store cannot be
        written.

        >>> project.claims.register()
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        if not self._project.config.claims:
            raise NotFound("sierra.toml declares no [claims.NAME]")
        return registration.register(self._loaded, Store.create(self._project.paths.store))

    def against(self, baseline: str, *names: str) -> tuple[regression.Changed, ...]:
        """Return how claims have changed since a baseline: all, or those with these names.

        Each has a `verdict`, its numbers as `text`, and the evaluation as `now`. Raises NotFound for an unknown baseline or
        claim.

        >>> project.claims.against("v1")
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.baselines.json has no baseline 'v1'; set it by: sierra claims --keep v1
        """
        before = baselines.read(self._project.paths.root, baseline)
        return regression.compare(self._project.config, self.evaluate(*names), before)

    def set_baseline(self, name: str, *words: str) -> tuple[Path, tuple[Evaluated, ...], tuple[str, ...]]:
        """Write the results of claims to `sierra.baselines.json`; return the file, the results, and the claims left out.

        `words` are prefixes of batches' ids, or the path of one package; without any, the batches are those of the project as
        it is now. Raises NotFound if no batch decides any claim.

        >>> project.claims.set_baseline("v1")
        Traceback (most recent call last):
            ...
        sierra.errors.NotFound: sierra.toml declares no [claims.NAME]
        """
        if not re.fullmatch(r"[\w.-]+", name):
            raise UsageError(f"{name!r} is no name of a baseline; use letters, digits, '.', '_' and '-'")
        store, among = self._chosen_batches(words)
        claims = evaluate.evaluate(self._loaded, store, among=among)
        kept = tuple(claim for claim in claims if claim.batches)
        if not kept:
            raise NotFound(f"no claim can be evaluated: {claims[0].text}")
        left = tuple(claim.name for claim in claims if not claim.batches)
        return baselines.write(self._project.paths.root, name, self._project.config, kept), kept, left

    def _chosen_batches(self, words: Sequence[str]) -> tuple[Store, list[str] | None]:
        """Return the store and the ids of the batches that words name, or those of a package; None for no words."""
        packages = [word for word in words if word.endswith(PACKAGED)]
        if packages and len(words) > 1:
            raise UsageError("name one package, or batches of this project")
        if packages:
            return batches_of_package(packages[0])
        return self._store, [self._project.records.batch(word) for word in words] or None
